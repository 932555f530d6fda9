"""Image sequences of PLUS and others: pixels turned, poses chained, numbers used with their units."""

import numpy as np
import pytest
from image_examples import frame_fields, grey, text_of, write_mha
from scipy.spatial.transform import RigidTransform, Rotation
from sweep_examples import frames_of

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import BModeSettings
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import load_sweep, open_recording
from speckle3d.io.metaimage import read_poses

BMODE = ImportSettings(column_pitch_mm=0.1, row_spacing_mm=0.2, dynamic_range_db=60.0)
RF = ImportSettings(
    sampling_rate_hz=40e6, vector_pitch_mm=0.3, centre_frequency_hz=6e6, bandwidth_hz=(4e6, 8e6)
)
LEVELS = ImportSettings(dynamic_range_db=60.0)


def given_over(base, **more):
    return base.model_copy(update=more)


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
    assert sweep.signal == BModeSettings(60.0)
    assert (sweep.grid.vector_pitch_mm, sweep.grid.sample_spacing_mm) == (0.1, 0.2)


def test_spacing_of_rf_gives_pitch_and_sampling_rate(tmp_path):
    rf = np.random.default_rng(0).integers(-2000, 2000, (2, 4, 30)).astype(np.int32)
    path = write_mha(tmp_path / "a.mha", rf, {"UltrasoundImageType": "RF_REAL"}, spacing="0.01925 0.25 1")
    sweep = load_sweep(path, given_over(RF, sampling_rate_hz=None, vector_pitch_mm=None))
    assert sweep.signal.sampling_rate_hz == pytest.approx(1540e3 / (2 * 0.01925))
    assert sweep.grid.vector_pitch_mm == 0.25
    assert sweep.frames.dtype == np.float32
    np.testing.assert_array_equal(frames_of(sweep), rf)


@pytest.mark.parametrize(
    ("orientation", "kind", "sign"), [("FM", "RF_I_LINE_Q_LINE", -1), ("NM", "RF_IQ_LINE", 1)]
)
def test_i_and_q_become_an_analytic_signal_of_positive_frequency(tmp_path, orientation, kind, sign):
    given_ = given_over(RF, demodulation_frequency_hz=0.0)
    signal = np.round(1000 * np.exp(0.6j * np.arange(64)) * np.arange(1, 4)[:, None])
    stored = signal[:, ::-1] if orientation == "NM" else signal
    axis = 1 if kind == "RF_I_LINE_Q_LINE" else 2
    pairs = np.stack([stored.real, sign * stored.imag], axis)
    pixels = pairs.reshape(1, *((6, 64) if axis == 1 else (3, 128))).astype(np.int16)
    fields = {"UltrasoundImageOrientation": orientation, "UltrasoundImageType": kind}
    sweep = load_sweep(write_mha(tmp_path / "a.mha", pixels, fields), given_)
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


def opened(tmp_path, frames, pixels=None, fields=(), settings_=BMODE):
    pixels = grey(len(frames)) if pixels is None else pixels
    return open_recording(write_mha(tmp_path / "a.mha", pixels, fields, frames), settings_)


def placed(sweep):
    return sweep.tracker.readings.world_from_sensor.as_matrix()


@pytest.mark.parametrize(
    ("change", "images", "poses"),
    [
        ({"Timestamp": "12.000"}, 11, 11),
        ({"ImageStatus": "INVALID"}, 11, 12),
        ({"ProbeToTrackerTransform": text_of(2 * np.eye(4))}, 12, 11),
    ],
)
def test_one_bad_row_is_left_out_and_counted(tmp_path, change, images, poses):
    true, frames = path_of(12)
    frames[5] |= change
    recording = opened(tmp_path, frames)
    assert (len(recording.sweep), len(recording.sweep.tracker.readings)) == (images, poses)
    kept = [i for i in range(12) if i != 5 or poses == 12]
    np.testing.assert_allclose(placed(recording.sweep), true.as_matrix()[kept], atol=1e-9)
    assert any("of 12 left out" in note for note in recording.notes)


def test_a_given_rate_counts_images_that_are_left_out(tmp_path):
    true, frames = path_of(12)
    frames[5]["ImageStatus"] = "INVALID"
    sweep = opened(tmp_path, frames, settings_=given_over(BMODE, frame_rate_hz=10.0)).sweep
    np.testing.assert_allclose(sweep.frame_time_s, np.delete(np.arange(12), 5) / 10.0)
    at_images = sweep.tracker.readings.at(sweep.frame_time_s).as_matrix()
    np.testing.assert_allclose(at_images, np.delete(true.as_matrix(), 5, axis=0), atol=1e-9)


@pytest.mark.parametrize("lost", [[5, 6], [0, 1]])
def test_a_lost_tool_that_is_written_as_the_identity_is_left_out(tmp_path, lost):
    true, frames = path_of(12)
    for i in lost:
        frames[i]["ProbeToTrackerTransform"] = text_of(np.eye(4))
    kept = np.delete(np.arange(12), lost)
    np.testing.assert_allclose(placed(opened(tmp_path, frames).sweep), true.as_matrix()[kept], atol=1e-9)


def test_transforms_are_chosen_by_name(tmp_path):
    probe, reference, frames = frame_fields(3)
    path = write_mha(tmp_path / "a.mha", grey(), frames=frames)
    both = read_poses(path).readings.world_from_sensor
    # Six digits were written: 1e-6 of a rotation, 1e-3 of hundreds of mm.
    np.testing.assert_allclose(both.as_matrix(), (reference.inv() * probe).as_matrix(), atol=3e-3)
    alone = read_poses(path, ImportSettings(reference_transform="none")).readings.world_from_sensor
    np.testing.assert_allclose(alone.as_matrix(), probe.as_matrix(), atol=1e-3)
    assert load_sweep(path, given_over(BMODE, tracker_transform="none")).tracker is None
    with pytest.raises(InvalidInputError, match=r"StylusToTracker.*ProbeToTracker"):
        read_poses(path, ImportSettings(tracker_transform="StylusToTracker"))


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


@pytest.mark.realdata
def test_recordings_of_others(realdata):
    liver = ImportSettings(centre_frequency_hz=12e6, bandwidth_hz=(8e6, 16e6), frame_rate_hz=30.0)
    sweep = load_sweep(realdata / "rf" / "MouseLiverRF.mha", liver)
    assert sweep.frames.shape == (4, 128, 1536)
    # The header's 0.0128417 mm per sample at 1540 m/s is 60 MHz to 0.1 %.
    assert sweep.signal.sampling_rate_hz == pytest.approx(60e6, rel=2e-3)
    spaced = given_over(BMODE, column_pitch_mm=0.085, row_spacing_mm=0.085)
    for name, count in (("BoneUltrasound_L14.igs.mha", 21), ("NwirePhantomFreehand.igs.nrrd", 97)):
        sweep = load_sweep(realdata / "plus" / name, spaced)
        assert sweep.frames.shape == (count, 820, 616)
        assert sweep.tracker.covers(sweep.frame_time_s).all()
        assert 20 < sweep.frames[0].max() <= 255


@pytest.mark.realdata
def test_tracker_recordings_without_images(realdata, tmp_path):
    buffer = realdata / "plus" / "WaterTankBottomTranslationTrackerBuffer.igs.mha"
    assert len(read_poses(buffer).readings) == 5000
    with pytest.raises(InvalidInputError, match="expected pixels"):
        load_sweep(buffer, BMODE)
    # Newer versions of PLUS write no type of pixels.
    empty = write_mha(
        tmp_path / "a.mha", np.zeros((3, 0, 0), np.uint8), {"ElementType": "MET_OTHER"}, path_of(3)[1]
    )
    assert len(read_poses(empty).readings) == 3
