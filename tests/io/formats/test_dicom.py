import numpy as np
import pytest
from format_examples import region, write_dicom
from sweep_examples import frames_of

from speckle3d.cli.describe import describe
from speckle3d.core.errors import FileError
from speckle3d.core.grid import ImageGrid
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.load import load_sweep, open_recording

pytest.importorskip("pydicom")

RANGE = ImportSettings(dynamic_range_db=60.0)
BOX = 5, 8, 24, 45
"""First column and row, last column and row."""


def images(frames=4, rows=50, columns=30, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (frames, rows, columns)).astype(np.uint8)


def tissue(pixels):
    return pixels[:, BOX[1] : BOX[3] + 1, BOX[0] : BOX[2] + 1].transpose(0, 2, 1)


@pytest.fixture
def write_image(tmp_path):
    def write(pixels=None, regions=None, **elements):
        regions = [region(*BOX)] if regions is None else regions
        return write_dicom(tmp_path / "arm.dcm", images() if pixels is None else pixels, regions, **elements)

    return write


def test_the_region_of_tissue_with_its_scale_in_cm(write_image):
    trace = region(0, 46, 29, 49, RegionSpatialFormat=4, RegionDataType=10, PhysicalUnitsXDirection=4)
    path = write_image(regions=[trace, region(*BOX)])
    sweep = load_sweep(path, RANGE)
    np.testing.assert_array_equal(frames_of(sweep), tissue(images()))
    assert sweep.grid == ImageGrid(20, 38, 10 * 0.011, 10 * 0.007, 10 * 0.25)
    np.testing.assert_allclose(sweep.frame_time_s, 0.04 * np.arange(4), rtol=1e-12)
    rows = describe(path)
    assert any(name == "region left out" and "rows 46 to 49" in value for name, value, _ in rows)
    content = path.read_bytes()
    assert b"Doe^Jane" in content
    assert "Doe" not in repr(rows) + repr(sweep)
    # Without file meta information, as devices store what they send.
    path.write_bytes(content[content.index(b"\x08\0\x16\0") :])
    np.testing.assert_array_equal(frames_of(load_sweep(path, RANGE)), tissue(images()))


def test_rows_that_run_upwards_are_turned_over(write_image):
    """Depth of the region's last row by its reference pixel, 0.25 + (37 - 0) * -0.007 cm, is the first."""
    sweep = load_sweep(write_image(regions=[region(*BOX, PhysicalDeltaY=-0.007)]), RANGE)
    np.testing.assert_array_equal(frames_of(sweep), tissue(images())[:, :, ::-1])
    assert sweep.grid.first_sample_depth_mm == pytest.approx(10 * (0.25 - 37 * 0.007))


@pytest.mark.parametrize(
    ("elements", "times"),
    [
        ({"FrameTime": 50.0, "CineRate": 10}, [0, 0.05, 0.1, 0.15]),
        ({"FrameTime": None, "FrameTimeVector": [0, 40, -10, 40]}, [0, 0.03, 0.07]),
        ({"FrameTime": None, "CineRate": 25}, [0, 0.04, 0.08, 0.12]),
        ({"FrameTime": None}, None),
    ],
)
def test_times_of_frames(write_image, elements, times):
    recording = open_recording(write_image(**elements), RANGE)
    if times is None:
        with pytest.raises(MissingSettingsError, match="--frame-rate-hz"):
            _ = recording.sweep
        return
    np.testing.assert_allclose(recording.sweep.frame_time_s, times, atol=1e-12)
    assert any("1 of 4 left out" in note for note in recording.notes) == (len(times) < 4)


def test_grey_in_three_colours_and_from_white_to_black(write_image):
    colours = np.repeat(images()[..., None], 3, axis=3)
    colours[:, 0, 0] = 255, 0, 0  # outside the region
    for pixels, photometric, level in ((colours, "RGB", 0), (images(), "MONOCHROME1", 255)):
        sweep = load_sweep(write_image(pixels, photometric=photometric), RANGE)
        np.testing.assert_array_equal(frames_of(sweep), np.abs(level - tissue(images()).astype(int)))
    colours[3, 12, 9] = 200, 100, 0
    recording = open_recording(write_image(colours, photometric="RGB"), RANGE)
    assert "in colour" in recording.notes[0]
    assert recording.sweep.frames[3][9 - BOX[0], 12 - BOX[1]] == round(0.299 * 200 + 0.587 * 100)


@pytest.mark.parametrize("reference", [True, False])
def test_columns_in_degrees_are_the_lines_of_a_fan(write_image, reference):
    """Twenty columns of 2 degrees, the tenth straight down; the array's radius is asked for."""
    polar = {"PhysicalUnitsXDirection": 12, "PhysicalDeltaX": 2.0, "ReferencePixelX0": 10}
    polar |= {} if reference else {"ReferencePixelX0": None}
    path = write_image(regions=[region(*BOX, **polar)])
    with pytest.raises(MissingSettingsError) as error:
        load_sweep(path, RANGE)
    angles = {} if reference else {"line_angles_deg": (-20.0, 18.0)}
    assert set(error.value.settings) == {"array_radius_mm", *angles}
    sweep = load_sweep(path, RANGE.model_copy(update={"array_radius_mm": 45.0, **angles}))
    np.testing.assert_array_equal(frames_of(sweep), tissue(images()))
    assert (sweep.grid.fan.radius_mm, sweep.grid.first_sample_depth_mm) == (45.0, 2.5)
    np.testing.assert_allclose(np.rad2deg(sweep.grid.angle_rad([0, 19])), [-20.0, 18.0])


@pytest.mark.parametrize("share", [0.5, 0.99])
def test_a_file_cut_short_tells_how_many_frames_are_whole(write_image, share):
    pixels = images(10)
    path = write_image(pixels)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) - pixels.size + int(share * pixels.size)])
    with pytest.raises(FileError, match=f"ends early: {int(10 * share)} of 10 frames"):
        load_sweep(path, RANGE)
