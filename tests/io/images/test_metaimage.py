"""Image sequences of PLUS and others: pixels turned, poses chained, numbers used with their units."""

import numpy as np
import pytest
from image_examples import frame_fields, grey, text_of, write_mha
from scipy.spatial.transform import RigidTransform, Rotation
from sweep_examples import frames_of

from speckle3d.core.errors import InvalidInputError, Speckle3DError
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import load_sweep, open_recording

BMODE = ImportSettings(column_pitch_mm=0.1, row_spacing_mm=0.2, dynamic_range_db=60.0)
RF = ImportSettings(
    sampling_rate_hz=40e6, vector_pitch_mm=0.3, centre_frequency_hz=6e6, bandwidth_hz=(4e6, 8e6)
)
LEVELS = ImportSettings(dynamic_range_db=60.0)


def given_over(base, **changes):
    return base.model_copy(update=changes)


@pytest.mark.parametrize(
    ("orientation", "turn"),
    [
        ("MFA", lambda p: p.transpose(0, 2, 1)),
        ("UF", lambda p: p[:, :, ::-1].transpose(0, 2, 1)),
        ("NU", lambda p: p[:, ::-1, ::-1]),
    ],
)
def test_every_orientation_is_turned_to_vector_and_depth(tmp_path, orientation, turn):
    path = write_mha(tmp_path / "a.mha", grey(), {"UltrasoundImageOrientation": orientation})
    sweep = load_sweep(path, BMODE)
    np.testing.assert_array_equal(frames_of(sweep), turn(grey()))
    np.testing.assert_allclose(sweep.frame_time_s, [5.0, 5.1, 5.2])
    assert sweep.signal.dynamic_range_db == 60.0
    assert (sweep.grid.vector_pitch_mm, sweep.grid.sample_spacing_mm) == (0.1, 0.2)


def test_spacing_of_rf_gives_pitch_and_sampling_rate(tmp_path):
    rf = np.random.default_rng(0).integers(-2000, 2000, (2, 4, 30)).astype(np.int32)
    path = write_mha(tmp_path / "a.mha", rf, {"UltrasoundImageType": "RF_REAL"}, spacing="0.01925 0.25 1")
    sweep = load_sweep(path, given_over(RF, sampling_rate_hz=None, vector_pitch_mm=None))
    assert sweep.signal.sampling_rate_hz == pytest.approx(1540e3 / (2 * 0.01925))
    assert sweep.grid.vector_pitch_mm == 0.25
    assert sweep.frames.dtype == np.float32
    np.testing.assert_array_equal(frames_of(sweep), rf)


@pytest.mark.parametrize(("orientation", "kind"), [("FM", "RF_I_LINE_Q_LINE"), ("NM", "RF_IQ_LINE")])
def test_i_and_q_become_an_analytic_signal(tmp_path, orientation, kind):
    settings = given_over(RF, demodulation_frequency_hz=0.0)
    signal = np.round(1000 * np.exp(0.6j * np.arange(64)) * np.arange(1, 4)[:, None])
    lines = signal[:, ::-1] if orientation == "NM" else signal
    axis = 1 if kind == "RF_I_LINE_Q_LINE" else 2
    pairs = np.stack([lines.real, lines.imag], axis)
    pixels = pairs.reshape(1, *((6, 64) if axis == 1 else (3, 128))).astype(np.int16)
    fields = {"UltrasoundImageOrientation": orientation, "UltrasoundImageType": kind}
    sweep = load_sweep(write_mha(tmp_path / "a.mha", pixels, fields), settings)
    assert sweep.frames.dtype == np.complex64
    np.testing.assert_array_equal(frames_of(sweep)[0], signal)


def path_of(n, step_mm=0.2):
    """A hand's slow path, and the fields of its frames."""
    turns = Rotation.from_rotvec(0.01 * np.arange(n)[:, None] * [0.2, 0.5, 1.0])
    places = np.array([10.0, -20.0, 300.0]) + step_mm * np.arange(n)[:, None] * [0.1, 0.2, 1.0]
    poses = RigidTransform.from_components(places, turns)
    frames = [
        {
            "Timestamp": f"{100 + 0.05 * i:.3f}",
            "ProbeToTrackerTransform": " ".join(map(repr, pose.as_matrix().ravel().tolist())),
            "ProbeToTrackerTransformStatus": "OK",
            "ImageStatus": "OK",
        }
        for i, pose in enumerate(poses)
    ]
    return poses, frames


def recording_of(tmp_path, frames, pixels=None, fields=(), settings_=BMODE):
    pixels = grey(len(frames)) if pixels is None else pixels
    return open_recording(write_mha(tmp_path / "a.mha", pixels, fields, frames), settings_)


def poses_of(path, settings=None):
    return open_recording(path, settings).tracker.readings.world_from_sensor


def pose_matrices(sweep):
    return sweep.tracker.readings.world_from_sensor.as_matrix()


@pytest.mark.parametrize(
    ("change", "images", "poses"),
    [
        ({"Timestamp": "12.000"}, 11, 11),
        ({"ImageStatus": "INVALID"}, 11, 12),
        ({"ProbeToTrackerTransform": text_of(2 * np.eye(4))}, 12, 11),
    ],
)
def test_a_bad_row_costs_that_row(tmp_path, change, images, poses):
    true, frames = path_of(12)
    frames[5] |= change
    recording = recording_of(tmp_path, frames)
    assert (len(recording.sweep), len(recording.sweep.tracker.readings)) == (images, poses)
    rows = [i for i in range(12) if i != 5 or poses == 12]
    np.testing.assert_allclose(pose_matrices(recording.sweep), true.as_matrix()[rows], atol=1e-9)
    assert any("of 12 left out" in note for note in recording.notes)


def test_a_given_rate_counts_images_that_are_left_out(tmp_path):
    true, frames = path_of(12)
    frames[5]["ImageStatus"] = "INVALID"
    sweep = recording_of(tmp_path, frames, settings_=given_over(BMODE, frame_rate_hz=10.0)).sweep
    np.testing.assert_allclose(sweep.frame_time_s, np.delete(np.arange(12), 5) / 10.0)
    at_images = sweep.tracker.readings.at(sweep.frame_time_s).as_matrix()
    np.testing.assert_allclose(at_images, np.delete(true.as_matrix(), 5, axis=0), atol=1e-9)


@pytest.mark.parametrize("rows", [[5, 6], [0, 1], [3, 4, 7, 8, 10]])
@pytest.mark.parametrize("place_mm", [0.0, -3.697314e28, 50.0])
def test_poses_of_a_lost_tool_are_no_readings_wherever_they_lie(tmp_path, rows, place_mm):
    """As the identity, or far away as by NDI, at any share; at another place again and again."""
    true, frames = path_of(12)
    lost = RigidTransform.from_translation([0.0, 0.0, place_mm]).as_matrix()
    for i in rows:
        frames[i]["ProbeToTrackerTransform"] = text_of(lost)
    expected = np.delete(true.as_matrix(), rows, axis=0)
    np.testing.assert_allclose(pose_matrices(recording_of(tmp_path, frames).sweep), expected, atol=1e-9)


def test_the_tool_is_what_the_image_is_on(tmp_path):
    true, frames = path_of(12)
    pixels = np.diag([0.1, 0.2, 0.2, 1.0])
    for frame, pose in zip(frames, true.as_matrix(), strict=True):
        frame["ArmToTrackerTransform"] = frame.pop("ProbeToTrackerTransform")
        frame["ImageToArmTransform"] = text_of(pixels)
        frame["ImageToTrackerTransform"] = text_of(pose @ pixels)
    recording = recording_of(tmp_path, frames)
    assert recording.chain == "ImageToArm * ArmToTracker"
    np.testing.assert_allclose(pose_matrices(recording.sweep), true.as_matrix(), atol=1e-9)


@pytest.mark.parametrize("change", [b"5 4 100000000000000", b"0 0 100000000000000", b"5 4 3\nspacings = 1"])
@pytest.mark.parametrize("is_packed", [b"False", b"True"])
def test_a_header_that_cannot_be_true_is_refused_in_one_line(tmp_path, change, is_packed):
    path = write_mha(tmp_path / "a.mha", grey(), frames=frame_fields(3)[2])
    content = path.read_bytes().replace(b"5 4 3", change)
    path.write_bytes(content.replace(b"CompressedData = False", b"CompressedData = " + is_packed))
    with pytest.raises(Speckle3DError) as error:
        load_sweep(path, BMODE)
    assert "\n" not in str(error.value)


def test_a_frame_beyond_the_images_is_left_out(tmp_path):
    path = write_mha(tmp_path / "a.mha", grey(), frames=frame_fields(3)[2])
    path.write_bytes(path.read_bytes().replace(b"Seq_Frame0002", b"Seq_Frame9999999"))
    recording = open_recording(path)
    assert len(recording.tracker.readings) == 2
    assert "1 of 3 left out" in recording.remarks[0]


def test_transforms_are_chosen_by_name(tmp_path):
    probe, reference, frames = frame_fields(3)
    path = write_mha(tmp_path / "a.mha", grey(), frames=frames)
    for name in (None, "ProbeToReference"):
        relative = poses_of(path, ImportSettings(tracker_transform=name))
        # Six digits were written: 1e-6 of a rotation, 1e-3 of hundreds of mm.
        np.testing.assert_allclose(relative.as_matrix(), (reference.inv() * probe).as_matrix(), atol=3e-3)
    alone = poses_of(path, ImportSettings(reference_transform="none"))
    np.testing.assert_allclose(alone.as_matrix(), probe.as_matrix(), atol=1e-3)
    assert load_sweep(path, given_over(BMODE, tracker_transform="none")).tracker is None
    with pytest.raises(InvalidInputError, match=r"StylusToTracker.*ProbeToTracker"):
        load_sweep(path, ImportSettings(tracker_transform="StylusToTracker"))


CASES = [
    ('sizes: 5 4 3\nkinds: domain domain list\nunits: "{}" "{}" "s"\nspacings: {} {} 0.05', lambda p: p),
    ('sizes: 5 4 3\nspace units: "{}" "{}"\nspace directions: ({},0) (0,{}) none', lambda p: p),
    (
        'sizes: 3 5 4 1\nkinds: list domain domain domain\nspace units: "{}" "{}" "{}"\n'
        "space directions: none ({},0,0) (0,{},0) (0,0,1)\naxis 0 index type:=numeric\n"
        "axis 0 index values:=0 0.05 0.1",
        lambda p: np.moveaxis(p, 0, -1),
    ),
]


@pytest.mark.parametrize(("form", "arrange"), CASES)
def test_axes_and_units_of_nrrd_are_those_it_says(tmp_path, form, arrange):
    fields = form.format(*["cm"] * form.count('"{}"'), 0.02, 0.01)
    head = f"NRRD0004\ntype: uint8\nencoding: raw\nendian: little\n{fields}\n\n"
    path = tmp_path / "a.nrrd"
    path.write_bytes(head.encode() + np.ascontiguousarray(arrange(grey())).tobytes())
    sweep = load_sweep(path, given_over(LEVELS, **({} if "0.05" in form else {"frame_rate_hz": 20.0})))
    assert (sweep.grid.vector_pitch_mm, sweep.grid.sample_spacing_mm) == pytest.approx((0.2, 0.1))
    np.testing.assert_array_equal(frames_of(sweep), grey().transpose(0, 2, 1))
    np.testing.assert_allclose(sweep.frame_time_s, [0, 0.05, 0.1])


def test_frames_beyond_the_index_of_their_axis_have_no_time(tmp_path):
    axes = "dimension: 3\nsizes: 5 4 5\nspacings: 0.1 0.2 nan\nkinds: domain domain list\n"
    index = "axis 2 index type:=numeric\naxis 2 index values:=1 1.1 1.2\n\n"
    path = tmp_path / "a.nrrd"
    path.write_bytes(f"NRRD0004\ntype: uint8\nencoding: raw\n{axes}{index}".encode() + grey(5).tobytes())
    recording = open_recording(path, LEVELS)
    np.testing.assert_allclose(recording.sweep.frame_time_s, [1.0, 1.1, 1.2])
    assert any("2 of 5 left out" in note for note in recording.notes)


@pytest.mark.realdata
def test_recordings_of_others(realdata):
    liver = ImportSettings(centre_frequency_hz=12e6, bandwidth_hz=(8e6, 16e6), frame_rate_hz=30.0)
    sweep = load_sweep(realdata / "rf" / "MouseLiverRF.mha", liver)
    assert sweep.frames.shape == (4, 128, 1536)
    # The header's 0.0128417 mm per sample at 1540 m/s is 60 MHz to 0.1 %.
    assert sweep.signal.sampling_rate_hz == pytest.approx(60e6, rel=2e-3)
    settings = given_over(BMODE, column_pitch_mm=0.085, row_spacing_mm=0.085)
    for name, count in (("BoneUltrasound_L14.igs.mha", 21), ("NwirePhantomFreehand.igs.nrrd", 97)):
        sweep = load_sweep(realdata / "plus" / name, settings)
        assert sweep.frames.shape == (count, 820, 616)
        assert sweep.tracker.covers(sweep.frame_time_s).all()
        assert 20 < sweep.frames[0].max() <= 255


@pytest.mark.realdata
def test_tracker_recordings_without_images(realdata, tmp_path):
    buffer = realdata / "plus" / "WaterTankBottomTranslationTrackerBuffer.igs.mha"
    assert len(poses_of(buffer)) == 5000
    with pytest.raises(InvalidInputError, match="expected pixels"):
        load_sweep(buffer, BMODE)
    # Newer versions of PLUS write no type of pixels, and sizes of fewer frames than there are fields of.
    fields = {"ElementType": "MET_OTHER", "DimSize": "0 0 1"}
    empty = write_mha(tmp_path / "a.mha", np.zeros((3, 0, 0), np.uint8), fields, path_of(3)[1])
    assert len(poses_of(empty)) == 3
