import numpy as np
import pytest
from format_examples import TISSUE, region, write_dicom

from speckle3d.core.errors import FileError, InvalidInputError, Speckle3DError
from speckle3d.core.sweep import BModeSettings, ImageGrid
from speckle3d.io.describe import describe
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.load import load_sweep, open_recording

pytest.importorskip("pydicom")

RANGE = ImportSettings(dynamic_range_db=60.0)
BOX = 5, 8, 24, 45
"""First column and row, last column and row."""


def images(frames=4, rows=50, columns=30, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (frames, rows, columns)).astype(np.uint8)


def cropped(shown, box=BOX):
    return shown[:, box[1] : box[3] + 1, box[0] : box[2] + 1].transpose(0, 2, 1)


def read(sweep):
    return np.stack([sweep.frames[i] for i in range(len(sweep))])


def test_the_region_of_tissue_with_its_scale_in_cm(tmp_path):
    sweep = load_sweep(write_dicom(tmp_path / "arm.dcm", images(), [region(*BOX)]), RANGE)
    np.testing.assert_array_equal(read(sweep), cropped(images()))
    assert sweep.grid == ImageGrid(20, 38, 10 * 0.011, 10 * 0.007, 10 * 0.25)
    assert sweep.signal == BModeSettings(60.0)
    np.testing.assert_allclose(sweep.frame_time_s, 0.04 * np.arange(4), rtol=1e-12)
    assert (sweep.name, sweep.tracker, sweep.orientation) == ("arm", None, None)


def test_rows_that_run_upwards_are_turned_over(tmp_path):
    """Depth of the region's last row by its reference pixel, 0.25 + (37 - 0) * -0.007 cm, is the first."""
    path = write_dicom(tmp_path / "a.dcm", images(), [region(*BOX, PhysicalDeltaY=-0.007)])
    sweep = load_sweep(path, RANGE)
    np.testing.assert_array_equal(read(sweep), cropped(images())[:, :, ::-1])
    assert sweep.grid.first_sample_depth_mm == pytest.approx(10 * (0.25 - 37 * 0.007))
    assert ("rows", "turned over: the file's y falls (PhysicalDeltaY below 0)", "") in describe(path)


def test_other_regions_are_left_out_and_told(tmp_path):
    trace = region(0, 46, 29, 49, RegionSpatialFormat=4, RegionDataType=10, PhysicalUnitsXDirection=4)
    path = write_dicom(tmp_path / "a.dcm", images(), [trace, region(*BOX)])
    np.testing.assert_array_equal(read(load_sweep(path, RANGE)), cropped(images()))
    assert ("region left out", "wave form ECG (columns 0 to 29, rows 46 to 49)", "") in describe(path)


def test_pixel_spacing_serves_where_there_are_no_regions(tmp_path):
    path = write_dicom(tmp_path / "a.dcm", images(), PixelSpacing=[0.2, 0.3])
    sweep = load_sweep(path, RANGE)
    assert sweep.grid == ImageGrid(30, 50, 0.3, 0.2, 0.0)
    assert any("the whole image, taken for Cartesian" in value for _, value, _ in describe(path))


@pytest.mark.parametrize(
    ("elements", "times"),
    [
        ({"FrameTime": 50.0}, 0.05 * np.arange(4)),
        ({"FrameTime": None, "FrameTimeVector": [0.0, 10.0, 20.0, 15.0]}, [0, 0.01, 0.03, 0.045]),
        ({"FrameTime": None, "CineRate": 25}, 0.04 * np.arange(4)),
        ({"FrameTime": None, "RecommendedDisplayFrameRate": 50}, 0.02 * np.arange(4)),
    ],
)
def test_times_of_frames(tmp_path, elements, times):
    sweep = load_sweep(write_dicom(tmp_path / "a.dcm", images(), [region(*BOX)], **elements), RANGE)
    np.testing.assert_allclose(sweep.frame_time_s, times, atol=1e-12)


def test_a_given_rate_stands_in_for_times_that_are_not_of_the_frames(tmp_path):
    wrong = {"FrameTime": None, "FrameTimeVector": [0.0, 10.0]}
    path = write_dicom(tmp_path / "a.dcm", images(), [region(*BOX)], **wrong)
    with pytest.raises(MissingSettingsError, match="--frame-rate-hz"):
        load_sweep(path, RANGE)
    sweep = load_sweep(path, RANGE.model_copy(update={"frame_rate_hz": 20.0}))
    np.testing.assert_allclose(sweep.frame_time_s, 0.05 * np.arange(4))


def test_rates_that_disagree_are_told(tmp_path):
    path = write_dicom(tmp_path / "a.dcm", images(), [region(*BOX)], FrameTime=50.0, CineRate=10)
    assert any("FrameTime, CineRate says 10" in value for _, value, _ in describe(path))


def test_all_that_is_missing_is_asked_for_at_once(tmp_path):
    path = write_dicom(tmp_path / "a.dcm", images(), FrameTime=None)
    with pytest.raises(MissingSettingsError) as caught:
        load_sweep(path)
    missing = ("column_pitch_mm", "row_spacing_mm", "dynamic_range_db", "frame_rate_hz")
    assert caught.value.settings == missing


def test_grey_in_three_colours_and_inverted(tmp_path):
    grey = images()
    coloured = np.repeat(grey[..., None], 3, axis=3)
    path = write_dicom(tmp_path / "a.dcm", coloured, [region(*BOX)], photometric="RGB")
    np.testing.assert_array_equal(read(load_sweep(path, RANGE)), cropped(grey))
    path = write_dicom(tmp_path / "b.dcm", grey, [region(*BOX)], photometric="MONOCHROME1")
    np.testing.assert_array_equal(read(load_sweep(path, RANGE)), 255 - cropped(grey))


def test_a_colour_anywhere_in_the_region_is_refused(tmp_path):
    coloured = np.repeat(images()[..., None], 3, axis=3)
    coloured[:, 0, 0] = 255, 0, 0  # outside the region
    path = write_dicom(tmp_path / "a.dcm", coloured, [region(*BOX)], photometric="RGB")
    np.testing.assert_array_equal(read(load_sweep(path, RANGE)), cropped(images()))
    coloured[3, 12, 9] = 200, 100, 0
    path = write_dicom(tmp_path / "b.dcm", coloured, [region(*BOX)], photometric="RGB")
    sweep = load_sweep(path, RANGE)
    with pytest.raises(
        InvalidInputError, match=r"frame 3: expected grey, got 1 pixels of a colour.*column 4, row 4"
    ):
        sweep.frames[3]
    coloured[2, 12, 9] = 200, 100, 0
    path = write_dicom(tmp_path / "c.dcm", coloured, [region(*BOX)], photometric="RGB")
    with pytest.raises(InvalidInputError, match="colour Doppler or an overlay"):
        load_sweep(path, RANGE)


def test_packed_pixels_are_those_of_unpacked_ones(tmp_path):
    from pydicom.uid import RLELossless

    path = write_dicom(tmp_path / "a.dcm", images(), [region(*BOX)], syntax=RLELossless)
    np.testing.assert_array_equal(read(load_sweep(path, RANGE)), cropped(images()))


def test_pixels_packed_with_loss_are_close_and_told(tmp_path):
    from io import BytesIO

    from PIL import Image
    from pydicom.uid import JPEGBaseline8Bit

    shown = np.array([np.add.outer(np.arange(50), 2 * np.arange(30)) + i for i in range(4)]).astype(np.uint8)
    packed = []
    for image in shown:
        stream = BytesIO()
        Image.fromarray(image).save(stream, "JPEG", quality=95)
        packed.append(stream.getvalue())
    given = {"claimed": JPEGBaseline8Bit, "packed": packed, "LossyImageCompression": "01"}
    path = write_dicom(tmp_path / "a.dcm", shown, [region(*BOX)], **given)
    # A smooth image at quality 95 comes back within 3 levels.
    difference = read(load_sweep(path, RANGE)).astype(int) - cropped(shown)
    assert np.abs(difference).max() <= 3
    assert ("pixels", "packed with loss, which smooths speckle", "") in describe(path)


def test_what_cannot_be_unpacked_here_names_the_syntax_and_the_package(tmp_path):
    from pydicom.pixels import get_decoder
    from pydicom.uid import JPEGLSLossless

    if get_decoder(JPEGLSLossless).is_available:
        pytest.skip("needs an installation that cannot unpack JPEG-LS")
    path = write_dicom(tmp_path / "a.dcm", images(), [region(*BOX)], claimed=JPEGLSLossless)
    with pytest.raises(Speckle3DError, match="JPEG-LS"):
        load_sweep(path, RANGE)
    assert describe(path)[-1][0] == "sweep"


def test_no_name_of_a_patient_is_told(tmp_path):
    path = write_dicom(tmp_path / "a.dcm", images(), [region(*BOX)])
    assert b"Doe^Jane" in path.read_bytes()
    sweep = load_sweep(path, RANGE)
    assert "Doe" not in repr(describe(path)) + repr(sweep)


TAMPERED = {
    "a single image": ({"images": images(1)}, "expected several frames, got a single image"),
    "of another modality": ({"Modality": "CT"}, "Modality: expected US, got CT"),
    "16 bits": ({"images": images().astype(np.uint16)}, "BitsAllocated: expected 8, got 16"),
    "a palette": ({"photometric": "PALETTE COLOR"}, "expected MONOCHROME1 or MONOCHROME2, got PALETTE COLOR"),
    "Doppler alone": (
        {"regions": [region(*BOX, RegionSpatialFormat=3, RegionDataType=3)]},
        r"expected one region of 2-D tissue, got 0 of spectrum pulsed Doppler",
    ),
    "two images": ({"regions": [region(0, 0, 9, 9), region(10, 0, 19, 9)]}, "got 2 of 2-D tissue"),
    "a colour box": ({"regions": [region(*BOX, RegionDataType=2)]}, "got 0 of 2-D colour flow"),
    "polar": (
        {"regions": [region(*BOX, PhysicalUnitsXDirection=12)]},
        "a polar image has to be scan-converted",
    ),
    "no scale": ({"regions": [region(*BOX, PhysicalDeltaX=0.0)]}, "PhysicalDeltaX, PhysicalDeltaY"),
    "scale left out": ({"regions": [region(*BOX, PhysicalDeltaX=None)]}, "PhysicalDeltaX: expected a number"),
    "outside": ({"regions": [region(5, 8, 30, 45)]}, "expected a region within 30 x 50 pixels"),
    "reversed": ({"regions": [region(24, 8, 5, 45)]}, "expected a region within"),
    "no rows": ({"Rows": 0}, "expected an image"),
    "more frames than pixels": ({"NumberOfFrames": 400}, "ends early: 4 of 400 frames"),
    "absurd": ({"NumberOfFrames": 2**31 - 1, "Rows": 65535, "Columns": 65535}, "a.dcm"),
}


@pytest.mark.parametrize("name", TAMPERED)
def test_what_cannot_be_is_refused_in_one_line(tmp_path, name):
    given, said = TAMPERED[name]
    given = {"images": images(), "regions": [region(*BOX)]} | given
    path = write_dicom(tmp_path / "a.dcm", given.pop("images"), **given)
    with pytest.raises(Speckle3DError, match=said) as caught:
        load_sweep(path, RANGE)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
    if isinstance(caught.value, InvalidInputError):
        assert describe(path)[-1][0] == "sweep"


def test_a_truncated_file_is_an_error_of_one_line(tmp_path):
    path = write_dicom(tmp_path / "a.dcm", images(), [region(*BOX)])
    path.write_bytes(path.read_bytes()[:-3000])
    with pytest.raises(FileError, match="ends early") as caught:
        load_sweep(path, RANGE)
    assert "\n" not in str(caught.value)


def test_without_pydicom_the_extra_is_named(tmp_path, monkeypatch):
    path = write_dicom(tmp_path / "a.dcm", images(), [region(*BOX)])
    monkeypatch.setitem(__import__("sys").modules, "pydicom", None)
    with pytest.raises(InvalidInputError, match=r'pip install "speckle3d\[dicom\]"'):
        load_sweep(path, RANGE)


def test_the_reference_pixel_is_counted_from_the_regions_first(tmp_path):
    changes = {"ReferencePixelY0": 10, "ReferencePixelPhysicalValueY": 0.0}
    sweep = load_sweep(write_dicom(tmp_path / "a.dcm", images(), [region(*BOX, **changes)]), RANGE)
    assert sweep.grid.first_sample_depth_mm == pytest.approx(-100 * TISSUE["PhysicalDeltaY"])


@pytest.mark.parametrize("kept", [0.5, 0.99])
def test_a_file_cut_short_tells_how_many_frames_are_whole(tmp_path, kept):
    images = np.random.default_rng(0).integers(0, 255, (10, 64, 48)).astype(np.uint8)
    path = write_dicom(tmp_path / "a.dcm", images, PixelSpacing=[0.1, 0.2])
    content = path.read_bytes()
    start = len(content) - images.size
    path.write_bytes(content[: start + int(kept * images.size)])
    with pytest.raises(FileError, match=f"ends early: {int(10 * kept)} of 10 frames"):
        load_sweep(path, ImportSettings(dynamic_range_db=60.0))
    assert "ends early" in dict(row[:2] for row in describe(path))["sweep"]


def test_frames_of_a_repeated_time_are_left_out(tmp_path):
    images = np.random.default_rng(0).integers(0, 255, (4, 64, 48)).astype(np.uint8)
    path = write_dicom(
        tmp_path / "a.dcm", images, PixelSpacing=[0.1, 0.2], FrameTime=None, FrameTimeVector=[0, 40, 0, 40]
    )
    recording = open_recording(path, ImportSettings(dynamic_range_db=60.0))
    np.testing.assert_allclose(recording.sweep.frame_time_s, [0, 0.04, 0.08])
    assert any("1 of 4 left out" in note for note in recording.notes)
