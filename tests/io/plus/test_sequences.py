"""Sequences written and read back, and through a sweep file, are equal in every field."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import sweep_examples
from image_examples import grey, text_of, tracked, write_mha
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.streams import TimedPoses
from speckle3d.core.sweep import Tracker
from speckle3d.io.describe import describe
from speckle3d.io.headers import read_header
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import import_notes, load_sweep
from speckle3d.io.pixels import read_pixels
from speckle3d.io.plus.layout import layout_of
from speckle3d.io.plus.record import record_of
from speckle3d.io.plus.write import write_sequence
from speckle3d.io.sweep_writer import write_sweep
from speckle3d.io.sweeps import read_sweep

BMODE = ImportSettings(column_pitch_mm=0.1, row_spacing_mm=0.2, dynamic_range_db=60.0)
RF = ImportSettings(
    sampling_rate_hz=40e6,
    vector_pitch_mm=0.3,
    centre_frequency_hz=6e6,
    bandwidth_hz=(4e6, 8e6),
    demodulation_frequency_hz=0.0,
)


def rich(n=4):
    """Fields of frames with everything that PLUS writes, and things it does not."""
    _, _, frames = tracked(n)
    for i, frame in enumerate(frames):
        frame |= {
            "UnfilteredTimestamp": f"{4.9 + 0.1 * i:.6f}",
            "FrameNumber": f"{500 + i} ",
            "Stylus": "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1",
            "StylusToTrackerTransform": "9.14047e-005 -0 1 0 0 1 0 0.1 0 0 1 1234567.890123 0 0 -0 1",
            "StylusToTrackerTransformStatus": "MISSING" if i else "OUT_OF_VIEW",
            "ImageStatus": "INVALID" if i == 2 else "OK",
            "BrokenTransform": "1 2 3",
        }
    frames[1]["Comment"] = "only here, mit Umlaut ä = 3"
    frames[3]["ReferenceToTrackerTransformStatus"] = "INVALID"
    del frames[3]["StylusToTrackerTransform"]
    return frames


CUSTOM = {"DefaultFrameTransformName": "ProbeToTrackerTransform", "CustomText": "a: b := c"}


def numbers_or_text(text):
    try:
        return tuple(float(word) for word in text.split())
    except ValueError:
        return text


def content(path):
    """All that a sequence says, and its pixels; numbers by value, and a frame without image as zeros."""
    header = read_header(path)
    record = record_of(header, layout_of(header))
    x, y, *n = header.size
    pixels = read_pixels(header.pixels).reshape(*n, y, x).copy()
    if n:
        pixels[~record.has_image if record.frames else np.zeros(n[0], dtype=bool)] = 0
    fields = {k: numbers_or_text(v) for k, v in record.fields.items() if not k.startswith("Speckle3D_")}
    frames = [{k: numbers_or_text(v) for k, v in frame.items()} for frame in record.frames]
    return fields, frames, pixels


def assert_same(got, expected, added=()):
    """Compare two files in every field; `added` may be there besides."""
    fields, frames, pixels = content(got)
    assert fields == content(expected)[0]
    left = [{k: v for k, v in frame.items() if k not in added} for frame in frames]
    assert left == content(expected)[1]
    np.testing.assert_array_equal(pixels, content(expected)[2])
    assert pixels.dtype == content(expected)[2].dtype
    assert [[str(v) for v in f.values()] for f in left] == [  # the sign of zero, too
        [str(f[k]) for k in g] for f, g in zip(content(expected)[1], left, strict=True)
    ]


@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("suffix", [".igs.mha", ".mhd", ".igs.nrrd", ".seq.nrrd"])
def test_every_field_survives_a_sweep_file_and_each_container(tmp_path, suffix, compressed):
    fields = {"UltrasoundImageOrientation": "UFA", **CUSTOM}
    path = write_mha(tmp_path / "in.mha", grey(4), fields, rich(), spacing="0.1 0.2 7")
    sweep = load_sweep(path, ImportSettings(dynamic_range_db=60.0))
    write_sweep(tmp_path / "sweep.h5", sweep)
    for source in (sweep, read_sweep(tmp_path / "sweep.h5")):
        out = tmp_path / f"out{suffix}"
        assert write_sequence(out, source, compressed=compressed) == []
        if suffix.endswith(".nrrd"):  # which has no third spacing, as a sequence has none
            content(out)[0]["ElementSpacing"] = (0.1, 0.2, 7.0)
            path = write_mha(tmp_path / "in.mha", grey(4), fields, rich(), spacing="0.1 0.2 1")
        assert_same(out, path)
        again = load_sweep(out)  # nothing is asked for
        np.testing.assert_array_equal(again.frames[2], sweep.frames[2])
        assert (again.grid, again.signal) == (sweep.grid, sweep.signal)
        np.testing.assert_array_equal(again.frame_time_s, [5.0, 5.1, 5.3])
        np.testing.assert_array_equal(again.tracker.readings.time_s, [5.0, 5.1, 5.2])
        np.testing.assert_allclose(
            again.tracker.readings.world_from_sensor.as_matrix(),
            sweep.tracker.readings.world_from_sensor.as_matrix(),
            atol=1e-12,
        )


@pytest.mark.parametrize(
    ("orientation", "dtype"),
    [
        *((each, np.int16) for each in ("FM", "NM", "FU", "NU", "MF", "UN")),
        ("FM", np.int32),
        ("UN", np.float32),
    ],
)
@pytest.mark.parametrize("kind", ["RF_REAL", "RF_IQ_LINE", "RF_I_LINE_Q_LINE"])
def test_rf_and_i_and_q_of_every_layout_survive(tmp_path, orientation, kind, dtype):
    values = np.random.default_rng(3).integers(-3000, 3000, (2, 6, 8)).astype(dtype)
    fields = {"UltrasoundImageOrientation": orientation, "UltrasoundImageType": kind}
    path = write_mha(tmp_path / "in.mha", values, fields)
    sweep = load_sweep(path, RF)
    out = tmp_path / "out.mha"
    write_sweep(tmp_path / "a.h5", sweep)
    for source in (sweep, read_sweep(tmp_path / "a.h5")):
        assert write_sequence(out, source) == []
        assert_same(out, path)
        again = load_sweep(out)
        np.testing.assert_array_equal(again.frames[1], sweep.frames[1])
        assert (again.grid, again.signal) == (sweep.grid, sweep.signal)


def test_the_least_of_16_bits_survives_a_turned_sign_of_q(tmp_path):
    lines = np.exp(-0.6j * np.arange(32)) * 30000
    values = np.stack([lines.real, lines.imag], axis=1).reshape(1, 1, 64).astype(np.int16)
    values[0, 0, 1] = -32768  # whose opposite int16 does not hold
    path = write_mha(tmp_path / "in.mha", values, {"UltrasoundImageType": "RF_IQ_LINE"})
    sweep = load_sweep(path, RF)
    assert sweep.frames.record.conjugated
    write_sweep(tmp_path / "a.h5", sweep)
    write_sequence(tmp_path / "out.mha", read_sweep(tmp_path / "a.h5"))
    assert_same(tmp_path / "out.mha", path)


def test_an_image_of_two_axes_stays_one(tmp_path):
    pixels = grey(1)
    path = write_mha(tmp_path / "in.mha", pixels)
    flat = path.read_bytes().replace(b"NDims = 3", b"NDims = 2").replace(b"DimSize = 5 4 1", b"DimSize = 5 4")
    path.write_bytes(flat.replace(b"ElementSpacing = 1 1 1", b"ElementSpacing = 1 1"))
    for suffix in (".mha", ".nrrd"):
        out = tmp_path / f"out{suffix}"
        write_sequence(out, load_sweep(path, BMODE))
        assert_same(out, path)


@pytest.mark.parametrize("make", [sweep_examples.bmode_sweep, sweep_examples.rf_sweep])
@pytest.mark.parametrize("suffix", [".mha", ".nrrd", ".seq.nrrd"])
def test_a_sweep_with_sensors_is_interpolated_at_its_frames(tmp_path, make, suffix):
    sweep = make()
    left_out = write_sequence(tmp_path / f"out{suffix}", sweep)
    assert [line.split(",")[0] for line in left_out] == [
        f"the tracker's {3 * len(sweep)} readings",
        f"the orientation sensor's {3 * len(sweep)} readings with what else it measured",
        "the true poses",
    ]
    got = load_sweep(tmp_path / f"out{suffix}")
    for i in range(len(sweep)):
        np.testing.assert_array_equal(got.frames[i], sweep.frames[i])
    assert got.frames.dtype == sweep.frames.dtype
    assert got.signal == sweep.signal
    np.testing.assert_array_equal(got.frame_time_s, sweep.frame_time_s)
    assert got.grid == sweep.grid
    for ours, theirs in ((got.tracker, sweep.tracker), (got.orientation, sweep.orientation)):
        covered = theirs.covers(sweep.frame_time_s)
        assert 0 < covered.sum() < len(sweep)  # the sensors end before the last frame
        np.testing.assert_array_equal(ours.readings.time_s, sweep.frame_time_s[covered])
        # Poses go through their matrices of doubles.
        np.testing.assert_allclose(
            ours.world_from_image(sweep.frame_time_s[covered]).as_matrix(),
            theirs.world_from_image(sweep.frame_time_s[covered]).as_matrix(),
            atol=1e-9,
        )
    statuses = [
        each["ProbeToTrackerTransformStatus"] for each in read_header(tmp_path / f"out{suffix}").frames
    ]
    assert statuses == ["OK" if each else "INVALID" for each in sweep.tracker.covers(sweep.frame_time_s)]


def test_pixels_have_unit_spacing_only_where_a_transform_gives_their_size(tmp_path):
    from dataclasses import replace

    sweep = sweep_examples.bmode_sweep()
    write_sequence(tmp_path / "with.mha", sweep)
    write_sequence(tmp_path / "without.mha", replace(sweep, tracker=None, orientation=None))
    assert read_header(tmp_path / "with.mha").spacing_mm is None
    assert read_header(tmp_path / "without.mha").spacing_mm == (0.085, 0.09)
    matrix = np.reshape(
        [
            float(word)
            for word in read_header(tmp_path / "with.mha").frames[0]["ImageToProbeTransform"].split()
        ],
        (4, 4),
    )
    corner = matrix @ [sweep.grid.vectors - 1, sweep.grid.samples - 1, 0, 1]
    expected = sweep.tracker.sensor_from_image.apply(sweep.grid.corners_mm[2])
    np.testing.assert_allclose(corner[:3], expected, atol=1e-12)


def test_a_tracker_that_is_another_replaces_the_sequence_own(tmp_path):
    from dataclasses import replace

    path = write_mha(tmp_path / "in.mha", grey(4), frames=rich())
    sweep = load_sweep(path, BMODE)
    moved = RigidTransform.from_translation([1.0, 2.0, 3.0]) * sweep.tracker.readings.world_from_sensor
    other = replace(sweep, tracker=Tracker(TimedPoses(sweep.tracker.readings.time_s, moved)))
    (line,) = write_sequence(tmp_path / "out.mha", other)
    assert "ProbeToTracker, ReferenceToTracker" in line
    got = load_sweep(tmp_path / "out.mha").tracker.readings.world_from_sensor
    np.testing.assert_allclose(got.as_matrix(), moved.as_matrix(), atol=1e-9)
    frames = read_header(tmp_path / "out.mha").frames
    assert frames[1]["Comment"] == "only here, mit Umlaut ä = 3"
    assert "ReferenceToTrackerTransform" not in frames[0]
    delayed = replace(sweep, tracker=replace(sweep.tracker, time_offset_s=0.05))
    write_sequence(tmp_path / "late.mha", delayed)
    times = load_sweep(tmp_path / "late.mha").tracker.readings.time_s
    np.testing.assert_array_equal(times, [5.1, 5.2])


def test_a_calibration_beside_depth_is_where_the_first_sample_is(tmp_path):
    matrix = np.diag([0.1, 0.2, 0.15, 1.0])
    matrix[:3, 3] = 10, 20, 30
    frames = tracked(3)[2]
    for frame in frames:
        frame |= {"ImageToProbeTransform": text_of(matrix), "ImageToProbeTransformStatus": "OK"}
    path = write_mha(tmp_path / "a.mha", grey(), frames=frames)
    sweep = load_sweep(path, ImportSettings(dynamic_range_db=60.0, first_sample_depth_mm=4.0))
    assert (sweep.grid.vector_pitch_mm, sweep.grid.sample_spacing_mm) == (0.1, 0.2)
    # Pixel (0, 0) is where the header says, and y of P counts from the probe's face 4 mm above.
    np.testing.assert_allclose(sweep.tracker.sensor_from_image.apply([0, 4.0, 0]), [10, 20, 30])


def test_a_skewed_calibration_survives_a_sweep_file_and_a_sequence(tmp_path):
    """ImageToProbe of PLUS's spine phantom, whose axes lean by 2.7 degrees."""
    matrix = np.eye(4)
    matrix[:3] = [
        [-0.00157821, 0.0785919, -0.00803285, 15.3978],
        [-0.0839128, 0.00372697, 0.0153803, 49.5705],
        [0.0159024, 0.00714276, 0.0803604, -8.63446],
    ]
    _, _, frames = tracked(3)
    path = write_mha(tmp_path / "a.mha", grey(), frames=frames)
    given = ImportSettings(dynamic_range_db=60.0, image_to_probe=tuple(map(tuple, matrix)))
    sweep = load_sweep(path, given)
    assert np.rad2deg(sweep.tracker.image_skew_rad) == pytest.approx(-2.745, abs=1e-3)
    write_sweep(tmp_path / "a.h5", sweep)
    held = load_sweep(tmp_path / "a.h5")
    assert ("image axes off square", "-2.74", "deg") in describe(tmp_path / "a.h5")
    assert held.tracker.image_skew_rad == sweep.tracker.image_skew_rad
    write_sequence(tmp_path / "b.mha", held)
    back = load_sweep(tmp_path / "b.mha", ImportSettings(dynamic_range_db=60.0)).tracker
    assert back.image_skew_rad == pytest.approx(sweep.tracker.image_skew_rad, abs=1e-9)
    np.testing.assert_allclose(
        back.sensor_from_image.as_matrix(), sweep.tracker.sensor_from_image.as_matrix(), atol=1e-9
    )


def of_pixels(matrices, name):
    frames = [{"Timestamp": f"{5 + 0.1 * i:.6f}", "ImageStatus": "OK"} for i in range(len(matrices))]
    for frame, matrix in zip(frames, matrices, strict=True):
        frame[f"{name}Transform"] = " ".join(map(repr, matrix.ravel().tolist()))
        frame[f"{name}TransformStatus"] = "OK"
    return frames


@pytest.mark.parametrize("name", ["ImageToRoom", "RoomToImage"])
def test_poses_may_be_those_of_the_image_s_pixels(tmp_path, name):
    """Slicer and PLUS record ImageToReference, from pixels to mm."""
    pixels = np.array([[0.1, 0.008, 0, 0], [0, 0.2, 0, 0], [0, 0, 0.15, 0], [0, 0, 0, 1]])
    matrices = sweep_examples.poses(4).as_matrix() @ pixels
    held = of_pixels(matrices if name == "ImageToRoom" else np.linalg.inv(matrices), name)
    held[3][f"{name}TransformStatus"] = "INVALID"
    path = write_mha(tmp_path / "a.mha", grey(4), frames=held)
    given = ImportSettings(dynamic_range_db=60.0, tracker_transform="ImageToRoom", first_sample_depth_mm=2.0)
    sweep = load_sweep(path, given)
    assert len(sweep.tracker.readings) == 3
    grid = replace(sweep.grid, skew_rad=sweep.tracker.image_skew_rad)
    placed = sweep.tracker.world_from_image(sweep.frame_time_s[:3]).as_matrix() @ grid.image_from_sample
    np.testing.assert_allclose(placed, matrices[:3, :, [0, 1, 3]], atol=1e-9)
    write_sweep(tmp_path / "a.h5", sweep)
    write_sequence(tmp_path / "b.mha", load_sweep(tmp_path / "a.h5"))
    for got, expected in zip(read_header(tmp_path / "b.mha").frames, held, strict=True):
        assert {each for each in got if "To" in each} == {f"{name}Transform", f"{name}TransformStatus"}
        assert got[f"{name}TransformStatus"] == expected[f"{name}TransformStatus"]
        texts = got[f"{name}Transform"], expected[f"{name}Transform"]
        np.testing.assert_array_equal(*(np.array(each.split(), dtype=float) for each in texts))


def test_pixels_of_another_size_are_named(tmp_path):
    matrices = sweep_examples.poses(3).as_matrix() @ np.diag([0.1, 0.2, 0.15, 1.0])
    matrices[2, :3, 0] *= 1.1
    path = write_mha(tmp_path / "a.mha", grey(), frames=of_pixels(matrices, "ImageToReference"))
    given = ImportSettings(dynamic_range_db=60.0, tracker_transform="ImageToReference")
    with pytest.raises(InvalidInputError, match=r"ImageToReferenceTransform\[\d\]: expected pixels as of"):
        load_sweep(path, given)


@pytest.mark.parametrize(
    ("spacing", "changed", "message"),
    [
        ("0.3 0.2 1", {}, r"0\.3 x 0\.2 mm.*0\.1 x 0\.2 mm"),
        ("1 1 1", {"ImageToProbeTransform": text_of(np.diag([0.1, 0.3, 1, 1]))}, r"Transform\[2\]"),
        ("1 1 1", {"ImageToProbeTransform": "0 " * 16}, r"Transform\[2\]"),
    ],
)
def test_calibrations_that_contradict_are_refused(tmp_path, spacing, changed, message):
    frames = tracked(3)[2]
    for frame in frames:
        frame["ImageToProbeTransform"] = text_of(np.diag([0.1, 0.2, 0.15, 1.0]))
    frames[2] |= changed
    path = write_mha(tmp_path / "a.mha", grey(), frames=frames, spacing=spacing)
    with pytest.raises(InvalidInputError, match=message):
        load_sweep(path, ImportSettings(dynamic_range_db=60.0))


def test_all_that_is_missing_is_asked_for_at_once(tmp_path):
    path = write_mha(tmp_path / "a.mha", grey().astype(np.int16), frames=[])
    with pytest.raises(InvalidInputError) as caught:
        load_sweep(path)
    wanted = {"sampling_rate_hz", "vector_pitch_mm", "centre_frequency_hz", "bandwidth_hz", "frame_rate_hz"}
    assert {*caught.value.settings} == wanted


@pytest.mark.parametrize("spacing", ["0 0.3 1", "0.02 -1 1"])
@pytest.mark.parametrize("dtype", [np.uint8, np.int16])
def test_spacing_is_above_zero(tmp_path, spacing, dtype):
    path = write_mha(tmp_path / "a.mha", grey().astype(dtype), spacing=spacing)
    with pytest.raises(InvalidInputError, match=r"a\.mha: spacing of pixels: expected above zero"):
        load_sweep(path, ImportSettings(dynamic_range_db=60.0))


def test_a_volume_is_no_sequence_unless_its_frame_rate_is_given(tmp_path):
    path = write_mha(tmp_path / "a.mha", grey(), {"Kinds": "domain domain domain"}, frames=[])
    with pytest.raises(InvalidInputError, match=r"a\.mha: .*got a volume.*--frame-rate-hz"):
        load_sweep(path, BMODE)
    timed = BMODE.model_copy(update={"frame_rate_hz": 10.0})
    assert len(load_sweep(path, timed)) == 3
    assert import_notes(path, timed) == [
        "third axis is time, as the frame rate that is given says: by its Kinds it is in space"
    ]


@pytest.mark.parametrize("compressed", [True, False])
def test_itk_reads_the_same_pixels(tmp_path, compressed):
    import SimpleITK

    sweep = sweep_examples.rf_sweep()
    expected = np.stack([sweep.frames[i] for i in range(len(sweep))])
    for name in ("a.mha", "a.mhd"):
        write_sequence(tmp_path / name, sweep, compressed=compressed)
        image = SimpleITK.ReadImage(str(tmp_path / name))
        np.testing.assert_array_equal(SimpleITK.GetArrayFromImage(image), expected)
    write_sequence(tmp_path / "a.nrrd", sweep, compressed=compressed)
    image = SimpleITK.ReadImage(
        str(tmp_path / "a.nrrd")
    )  # a list of images is for ITK one of many components
    assert image.GetNumberOfComponentsPerPixel() == len(sweep)


def test_frames_go_to_other_processes_and_are_opened_again(tmp_path):
    frames = load_sweep(write_mha(tmp_path / "a.mha", grey(), frames=tracked(3)[2]), BMODE).frames
    expected = frames[1]
    again = pickle.loads(pickle.dumps(frames))
    frames.close()
    for each in (frames, again):
        np.testing.assert_array_equal(each[1], expected)
    assert again.record == frames.record


@pytest.mark.parametrize("kinds", ["list domain domain", "vector domain domain", "domain list domain"])
def test_frames_on_another_axis_are_not_taken_for_columns(tmp_path, kinds):
    path = write_mha(tmp_path / "a.mha", grey(), {"Kinds": kinds}, frames=[])
    with pytest.raises(InvalidInputError, match=rf"a\.mha: kinds: .*{kinds}"):
        load_sweep(path, BMODE.model_copy(update={"frame_rate_hz": 10.0}))


def test_names_of_other_files_are_refused(tmp_path):
    with pytest.raises(InvalidInputError, match=r"\.mha, \.mhd, \.nrrd, got '\.nii'"):
        write_sequence(tmp_path / "a.nii", sweep_examples.bmode_sweep())
