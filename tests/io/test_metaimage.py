from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from image_examples import grey, text_of, tracked, write_mha
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import FileError, InvalidInputError, Speckle3DError
from speckle3d.core.sweep import BModeSettings, RFSettings
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.metaimage import describe_sequence, read_metaimage, read_poses

BMODE = ImportSettings(column_pitch_mm=0.1, row_spacing_mm=0.2, dynamic_range_db=60.0)
RF = ImportSettings(
    sampling_rate_hz=40e6, vector_pitch_mm=0.3, centre_frequency_hz=6e6, bandwidth_hz=(4e6, 8e6)
)


def frames_of(sweep):
    return np.stack([sweep.frames[i] for i in range(len(sweep))])


@pytest.mark.parametrize(
    ("orientation", "turn"),
    [
        ("MF", lambda p: p.transpose(0, 2, 1)),
        ("MFA", lambda p: p.transpose(0, 2, 1)),
        ("UF", lambda p: p[:, :, ::-1].transpose(0, 2, 1)),
        ("MN", lambda p: p[:, ::-1].transpose(0, 2, 1)),
        ("FM", lambda p: p),
        ("NM", lambda p: p[:, :, ::-1]),
        ("NU", lambda p: p[:, ::-1, ::-1]),
    ],
)
def test_every_orientation_is_turned_to_vector_and_depth(tmp_path, orientation, turn):
    path = write_mha(tmp_path / "a.mha", grey(), {"UltrasoundImageOrientation": orientation})
    sweep = read_metaimage(path, BMODE)
    np.testing.assert_array_equal(frames_of(sweep), turn(grey()))
    np.testing.assert_allclose(sweep.frame_time_s, [5.0, 5.1, 5.2])
    assert sweep.signal == BModeSettings(60.0)
    assert (sweep.grid.vector_pitch_mm, sweep.grid.sample_spacing_mm) == (0.1, 0.2)


def test_spacing_in_the_header_is_used_where_no_setting_is_given(tmp_path):
    rf = np.random.default_rng(0).integers(-2000, 2000, (2, 4, 30)).astype(np.int32)
    path = write_mha(
        tmp_path / "a.mha", rf, spacing="0.01925 0.25 1", fields={"UltrasoundImageType": "RF_REAL"}
    )
    sweep = read_metaimage(path, RF.model_copy(update={"sampling_rate_hz": None, "vector_pitch_mm": None}))
    assert isinstance(sweep.signal, RFSettings)
    assert sweep.signal.sampling_rate_hz == pytest.approx(1540e3 / (2 * 0.01925))
    assert sweep.grid.vector_pitch_mm == 0.25
    assert sweep.frames.dtype == np.int16
    np.testing.assert_array_equal(frames_of(sweep), rf)


def test_values_beyond_16_bits_become_float(tmp_path):
    rf = np.array([[[0, 40000, -5, 7]]], dtype=np.int32)
    sweep = read_metaimage(write_mha(tmp_path / "a.mha", rf), RF)
    assert sweep.frames.dtype == np.float32
    np.testing.assert_array_equal(frames_of(sweep), rf)


@pytest.mark.parametrize("orientation", ["FM", "NM"])
@pytest.mark.parametrize("kind", ["RF_I_LINE_Q_LINE", "RF_IQ_LINE"])
@pytest.mark.parametrize("sign", [1, -1])
def test_i_and_q_become_an_analytic_signal_of_positive_frequency(tmp_path, orientation, kind, sign):
    depth = np.arange(64)
    given = RF.model_copy(update={"demodulation_frequency_hz": 0.0})
    signal = np.round(1000 * np.exp(0.6j * depth) * np.arange(1, 4)[:, None])
    stored = signal[:, ::-1] if orientation == "NM" else signal
    axis = 1 if kind == "RF_I_LINE_Q_LINE" else 2
    pairs = np.stack([stored.real, sign * stored.imag], axis)
    pixels = pairs.reshape(1, *((6, 64) if axis == 1 else (3, 128))).astype(np.int16)
    fields = {"UltrasoundImageOrientation": orientation, "UltrasoundImageType": kind}
    sweep = read_metaimage(write_mha(tmp_path / "a.mha", pixels, fields), given)
    assert sweep.frames.dtype == np.complex64
    assert sweep.signal.demodulation_frequency_hz == 0
    np.testing.assert_array_equal(frames_of(sweep)[0], signal)


@pytest.mark.parametrize(
    ("carrier_hz", "sampling_hz", "told"),
    [
        (4e6, 15e6, "told by the phase"),
        (-4e6, 15e6, "turned, as told by the phase"),
        (9e6, 15e6, "as stored, not told by the phase"),  # A turn of 3.8 rad seems to be one of -2.5.
        (14e6, 15e6, "as stored, not told by the phase"),
        (None, 40e6, "as stored, not told by the phase"),  # noise
    ],
)
def test_the_sign_of_q_is_turned_only_where_the_phase_tells(tmp_path, carrier_hz, sampling_hz, told):
    rng = np.random.default_rng(4)
    signal = 1e3 * rng.normal(size=(2, 4, 64, 2)).view(np.complex128)[..., 0]
    if carrier_hz is not None:
        signal = np.tile(3e3 * np.exp(2j * np.pi * carrier_hz / sampling_hz * np.arange(64)), (2, 4, 1))
    pixels = np.stack([signal.real, signal.imag], 3).reshape(2, 4, 128).round().astype(np.int16)
    given = RF.model_copy(
        update={
            "sampling_rate_hz": sampling_hz,
            "demodulation_frequency_hz": 0.0,
            "centre_frequency_hz": abs(carrier_hz or 9e6),
            "bandwidth_hz": (2e6, 15e6),
            "frame_rate_hz": 20.0,
        }
    )
    path = write_mha(tmp_path / "a.mha", pixels, {"UltrasoundImageType": "RF_IQ_LINE"}, frames=())
    sweep = read_metaimage(path, given)
    assert ("sign of Q", told, "") in describe_sequence(path, given)
    stored = pixels[..., 0::2] + 1j * pixels[..., 1::2]
    turned = told.startswith("turned")
    np.testing.assert_array_equal(frames_of(sweep), np.conj(stored) if turned else stored)
    assert sweep.frames.record.conjugated == turned


def test_an_invalid_frame_is_left_out_and_an_invalid_pose_is_dropped(tmp_path):
    probe, reference, frames = tracked(4)
    frames[1]["ImageStatus"] = "INVALID"
    frames[2]["ProbeToTrackerTransformStatus"] = "MISSING"
    frames[2]["ProbeToTrackerTransform"] = text_of(np.zeros((4, 4)))
    sweep = read_metaimage(write_mha(tmp_path / "a.mha", grey(4), frames=frames), BMODE)
    np.testing.assert_array_equal(frames_of(sweep), grey(4)[[0, 2, 3]].transpose(0, 2, 1))
    np.testing.assert_allclose(sweep.frame_time_s, [5.0, 5.2, 5.3])
    np.testing.assert_allclose(sweep.tracker.readings.time_s, [5.0, 5.1, 5.3])
    expected = (reference.inv() * probe)[[0, 1, 3]]
    # Six digits were written: 1e-6 of a rotation, 1e-3 of hundreds of mm.
    np.testing.assert_allclose(
        sweep.tracker.readings.world_from_sensor.as_matrix(), expected.as_matrix(), atol=3e-3
    )


def test_transforms_are_chosen_by_name(tmp_path):
    probe, reference, frames = tracked(3)
    path = write_mha(tmp_path / "a.mha", grey(), frames=frames)
    alone = read_poses(path, ImportSettings(reference_transform="none")).readings.world_from_sensor
    np.testing.assert_allclose(alone.as_matrix(), probe.as_matrix(), atol=1e-3)
    other = ImportSettings(tracker_transform="ReferenceToTrackerTransform", reference_transform="none")
    swapped = read_poses(path, other).readings.world_from_sensor
    np.testing.assert_allclose(swapped.as_matrix(), reference.as_matrix(), atol=1e-3)
    assert read_metaimage(path, BMODE.model_copy(update={"tracker_transform": "none"})).tracker is None
    with pytest.raises(InvalidInputError, match=r"StylusToTracker.*ProbeToTracker"):
        read_poses(path, ImportSettings(tracker_transform="StylusToTracker"))


def renamed(frames, old, new, change=lambda text: text):
    return [
        {
            name.replace(old, new): change(text) if name == f"{old}Transform" else text
            for name, text in frame.items()
        }
        for frame in frames
    ]


def inverted(text):
    return text_of(np.linalg.inv(np.reshape([float(x) for x in text.split()], (4, 4))))


def test_poses_of_any_name_are_found_with_the_reference_of_their_own_world(tmp_path):
    probe, reference, frames = tracked(3)
    tool = renamed(frames, "ProbeToTracker", "ToolToTracker")
    path = write_mha(tmp_path / "tool.mha", grey(), frames=tool)
    asked = ImportSettings(tracker_transform="ToolToTracker")
    found = read_poses(path, asked).readings.world_from_sensor
    expected = (reference.inv() * probe).as_matrix()
    np.testing.assert_allclose(found.as_matrix(), expected, atol=3e-3)
    assert read_metaimage(path, BMODE).tracker is None
    with pytest.raises(InvalidInputError, match=r"ReferenceToTracker, ToolToTracker.*--transform"):
        read_poses(path)
    # In another world that reference says nothing; as a sensor it is not held against itself.
    bed = write_mha(tmp_path / "bed.mha", grey(), frames=renamed(frames, "ProbeToTracker", "ToolToBed"))
    found = read_poses(bed, ImportSettings(tracker_transform="ToolToBed")).readings.world_from_sensor
    np.testing.assert_allclose(found.as_matrix(), probe.as_matrix(), atol=1e-3)
    itself = read_poses(path, ImportSettings(tracker_transform="ReferenceToTracker"))
    np.testing.assert_allclose(
        itself.readings.world_from_sensor.as_matrix(), reference.as_matrix(), atol=1e-3
    )


def test_a_transform_of_which_the_inverse_is_there_is_inverted(tmp_path):
    probe, reference, frames = tracked(3)
    frames[1]["ProbeToTrackerTransformStatus"] = "INVALID"
    turned = renamed(frames, "ProbeToTracker", "TrackerToTool", inverted)
    path = write_mha(tmp_path / "a.mha", grey(), frames=turned)
    found = read_poses(path, ImportSettings(tracker_transform="ToolToTracker")).readings
    # Six digits of hundreds of mm in the inverse, whose rotation has six as well.
    expected = (reference.inv() * probe)[[0, 2]].as_matrix()
    np.testing.assert_allclose(found.world_from_sensor.as_matrix(), expected, atol=5e-3)
    assert len(found) == 2


@given(
    scale=st.tuples(st.floats(0.01, 1), st.floats(0.01, 1)),
    seed=st.integers(0, 99),
    skew=st.floats(-0.05, 0.05),
    first_mm=st.sampled_from([0.0, 3.0]),
)
@settings(deadline=None, max_examples=25)
def test_an_image_calibration_in_pixels_gives_spacing_and_a_rigid_pose(
    tmp_path_factory, scale, seed, skew, first_mm
):
    rng = np.random.default_rng(seed)
    rotation, place = Rotation.random(rng=rng), rng.normal(0, 50, 3)
    matrix = np.eye(4)
    x, y = rotation.as_matrix().T[:2]
    # The skew is shared by both axes, so the nearest square pair is the one without it.
    x, y = np.cos(skew) * x + np.sin(skew) * y, np.sin(skew) * x + np.cos(skew) * y
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 3] = scale[0] * x, scale[1] * y, place
    matrix[:3, 2] = np.cross(x, y)
    _, _, frames = tracked(3)
    path = write_mha(tmp_path_factory.mktemp("calibration") / "a.mha", grey(), frames=frames)
    settings_ = ImportSettings(
        dynamic_range_db=60.0, image_to_probe=tuple(map(tuple, matrix)), first_sample_depth_mm=first_mm
    )
    sweep = read_metaimage(path, settings_)
    assert sweep.grid.vector_pitch_mm == pytest.approx(scale[0])
    assert sweep.grid.sample_spacing_mm == pytest.approx(scale[1])
    above = rotation.apply([0.0, first_mm, 0.0])
    expected = RigidTransform.from_components(place - above, rotation).as_matrix()
    np.testing.assert_allclose(sweep.tracker.sensor_from_image.as_matrix(), expected, atol=1e-9)
    # With the skew, the image's pixels lie where the calibration puts them.
    leaning = replace(sweep.grid, skew_rad=sweep.tracker.image_skew_rad)
    placed = sweep.tracker.sensor_from_image.as_matrix() @ leaning.image_from_sample
    np.testing.assert_allclose(placed, matrix[:, [0, 1, 3]], atol=1e-9)
    ends = [[0, 0], [4, 0], [4, 3], [0, 3]] @ matrix[:3, :2].T + place
    corners = sweep.tracker.sensor_from_image.apply(leaning.corners_mm)
    np.testing.assert_allclose(corners, ends, atol=1e-9)
    middle = sweep.tracker.sensor_from_image.apply(leaning.centre_mm)
    np.testing.assert_allclose(middle, ends.mean(axis=0), atol=1e-9)


@pytest.mark.parametrize(
    ("setting", "pixels"),
    [
        ("column_pitch_mm", grey()),
        ("row_spacing_mm", grey()),
        ("dynamic_range_db", grey()),
        ("sampling_rate_hz", grey().astype(np.int16)),
        ("vector_pitch_mm", grey().astype(np.int16)),
        ("centre_frequency_hz", grey().astype(np.int16)),
        ("bandwidth_hz", grey().astype(np.int16)),
    ],
)
def test_the_missing_setting_is_named(tmp_path, setting, pixels):
    full = BMODE if pixels.dtype == np.uint8 else RF
    with pytest.raises(MissingSettingsError, match=rf"a\.mha: .*--{setting.replace('_', '-')}") as caught:
        read_metaimage(write_mha(tmp_path / "a.mha", pixels), full.model_copy(update=dict(**{setting: None})))
    assert "\n" not in str(caught.value)


def test_a_frame_rate_stands_in_for_time_stamps(tmp_path):
    path = write_mha(tmp_path / "a.mha", grey(), frames=[])
    with pytest.raises(MissingSettingsError, match="--frame-rate-hz"):
        read_metaimage(path, BMODE)
    sweep = read_metaimage(path, BMODE.model_copy(update={"frame_rate_hz": 20.0}))
    np.testing.assert_allclose(sweep.frame_time_s, [0, 0.05, 0.1])


def changed(index, **fields):
    _, _, frames = tracked(3)
    frames[index] |= fields
    return frames


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (changed(1, Timestamp="4.0"), r"Timestamp\[1\]"),
        (changed(2, Timestamp="late"), r"Timestamp\[2\].*'late'"),
        (changed(2, Timestamp="nan"), r"Timestamp\[2\]"),
        (changed(1, ProbeToTrackerTransform="1 2 3"), r"ProbeToTrackerTransform\[1\].*16"),
        (changed(1, ProbeToTrackerTransform=text_of(2 * np.eye(4))), r"Transform\[1\]"),
        (tracked(3, ImageStatus="INVALID")[2], r"ImageStatus"),
        (tracked(3, ProbeToTrackerTransformStatus="INVALID")[2], r"TransformStatus"),
        (tracked(2)[2], r"3.*2"),
        ([*changed(2)[:2], {}], r"3.*2"),
    ],
)
def test_bad_fields_are_named_with_their_frame(tmp_path, frames, message):
    with pytest.raises(InvalidInputError, match=message):
        read_metaimage(write_mha(tmp_path / "a.mha", grey(), frames=frames), BMODE)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"UltrasoundImageOrientation": "MM"}, "UltrasoundImageOrientation.*MM"),
        ({"UltrasoundImageOrientation": "F"}, "UltrasoundImageOrientation"),
        ({"UltrasoundImageOrientation": "MFX"}, "expected as MF, FM or MFA, got MFX"),
        ({"UltrasoundImageType": "RGB_COLOR"}, "RGB_COLOR"),
        ({"UltrasoundImageType": "RF_I_LINE_Q_LINE", "ElementType": "MET_UCHAR"}, "I and Q"),
        ({"DimSize": "5 x 3"}, "DimSize"),
        ({"DimSize": "5 4 3 1"}, "DimSize"),
    ],
)
def test_bad_headers_are_refused(tmp_path, fields, message):
    pixels = grey(rows=5) if "RF_I_LINE_Q_LINE" in fields.values() else grey()
    with pytest.raises(InvalidInputError, match=message):
        read_metaimage(
            write_mha(tmp_path / "a.mha", pixels, fields), BMODE.model_copy(update={"bandwidth_hz": (1, 2)})
        )


@pytest.mark.parametrize("column", range(3))
def test_a_mirrored_image_calibration_is_refused(tmp_path, column):
    axes = np.diag([0.2, 0.2, 0.2, 1.0])
    axes[:, column] *= -1
    path = write_mha(tmp_path / "a.mha", grey(), {"ImageToProbeTransform": text_of(axes)}, tracked(3)[2])
    with pytest.raises(InvalidInputError, match=r"ImageToProbeTransform: expected right-handed.*-1\)"):
        read_metaimage(path, BMODE)
    axes[:, 2] = 0  # never measured
    path = write_mha(tmp_path / "a.mha", grey(), {"ImageToProbeTransform": text_of(axes)}, tracked(3)[2])
    found = read_metaimage(path, BMODE).tracker.sensor_from_image.rotation.as_matrix()
    np.testing.assert_allclose(found[:, :2], axes[:3, :2] / 0.2, atol=1e-12)


def test_poses_both_ways_round_are_inverses_or_refused(tmp_path):
    _, _, frames = tracked(3)
    name = "ProbeToTrackerTransform"
    both = [
        f | {"TrackerToProbeTransform": inverted(f[name]), "TrackerToProbeTransformStatus": "OK"}
        for f in frames
    ]
    path = write_mha(tmp_path / "a.mha", grey(), frames=both)
    alone = read_poses(write_mha(tmp_path / "b.mha", grey(), frames=frames))
    expected = alone.readings.world_from_sensor.as_matrix()
    np.testing.assert_array_equal(read_poses(path).readings.world_from_sensor.as_matrix(), expected)
    both[1]["TrackerToProbeTransform"] = both[1]["ProbeToTrackerTransform"]
    path = write_mha(tmp_path / "a.mha", grey(), frames=both)
    with pytest.raises(InvalidInputError, match=r"TrackerToProbeTransform\[1\].*inverse of ProbeToTracker"):
        read_poses(path)
    both[1]["TrackerToProbeTransformStatus"] = "INVALID"
    assert len(read_poses(write_mha(tmp_path / "a.mha", grey(), frames=both)).readings) == 3


def test_a_turned_image_calibration_is_refused(tmp_path):
    slanted = ((1.0, 0.5, 0, 0), (0, 1.0, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))
    path = write_mha(tmp_path / "a.mha", grey(), frames=tracked(3)[2])
    with pytest.raises(InvalidInputError, match=r"image_to_probe.*0\.447"):
        read_metaimage(path, BMODE.model_copy(update={"image_to_probe": slanted}))


@settings(deadline=None, max_examples=40)
@given(kept=st.floats(0, 1, exclude_max=True))
def test_a_truncated_file_is_one_line_wherever_it_ends(tmp_path_factory, kept):
    path = write_mha(tmp_path_factory.mktemp("cut") / "a.mha", grey(), frames=tracked(3)[2])
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(Speckle3DError, match=r"a\.mha: ") as caught:
        read_metaimage(path, BMODE)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_a_file_error(tmp_path):
    with pytest.raises(FileError, match="cannot be read: No such file"):
        read_metaimage(tmp_path / "none.mha")


@pytest.mark.realdata
def test_mouse_liver_rf(realdata):
    settings_ = ImportSettings(centre_frequency_hz=12e6, bandwidth_hz=(8e6, 16e6), frame_rate_hz=30.0)
    sweep = read_metaimage(realdata / "rf" / "MouseLiverRF.mha", settings_)
    assert sweep.frames.shape == (4, 128, 1536)
    assert sweep.frames.dtype == np.int16
    # The header's 0.0128417 mm per sample at 1540 m/s is 60 MHz to 0.1 %.
    assert sweep.signal.sampling_rate_hz == pytest.approx(60e6, rel=2e-3)
    # Echoes weaken with depth, so the first sample is next to the probe.
    frame = sweep.frames[0].astype(float)
    assert frame[:, :200].std() > 3 * frame[:, -200:].std()


@pytest.mark.realdata
def test_ultrasonix_i_and_q_lines(realdata):
    analytic = RF.model_copy(update={"demodulation_frequency_hz": 0.0})
    sweep = read_metaimage(realdata / "plus" / "UltrasonixLinearRfData.igs.mha", analytic)
    assert sweep.frames.shape == (1, 128, 2080)
    assert sweep.frames.dtype == np.complex64
    frame = sweep.frames[0]
    # Orientation NM stores the nearest sample last; turned round, the ring-down comes first.
    assert np.abs(frame[:, :200]).mean() > 20 * np.abs(frame[:, -200:]).mean()
    spectrum = (np.abs(np.fft.fft(frame[:, :600] * np.hanning(600))) ** 2).mean(axis=0)
    # Positive carrier near 0.1 cycles per sample: 4 MHz at the 40 MHz such machines sample at.
    peak = np.fft.fftfreq(600)[spectrum.argmax()]
    assert 0.08 < peak < 0.12


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "frames"),
    [
        ("BoneUltrasound_L14.igs.mha", 21),
        ("SpinePhantomFreehand.igs.mha", 21),
        ("NwirePhantomFreehand.igs.nrrd", 97),
    ],
)
def test_tracked_bmode_of_plus(realdata, name, frames):
    settings_ = BMODE.model_copy(update={"column_pitch_mm": 0.085, "row_spacing_mm": 0.085})
    sweep = read_metaimage(realdata / "plus" / name, settings_)
    assert sweep.frames.shape == (frames, 820, 616)
    assert len(sweep.tracker.readings) == frames
    assert sweep.tracker.covers(sweep.frame_time_s).all()
    assert 20 < sweep.frames[0].max() <= 255


@pytest.mark.realdata
def test_tracker_recordings_without_images(realdata):
    buffer = realdata / "plus" / "WaterTankBottomTranslationTrackerBuffer.igs.mha"
    assert len(read_poses(buffer).readings) == 5000
    with pytest.raises(InvalidInputError, match="expected pixels"):
        read_metaimage(buffer, BMODE)
    assert len(read_poses(realdata / "plus" / "TransformInterpolationTest.igs.mha").readings) == 499
