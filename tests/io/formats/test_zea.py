import h5py
import numpy as np
import pytest
from format_examples import (
    FIRST_MM,
    FRAMES,
    PITCH_MM,
    SAMPLES,
    SPACING_MM,
    VECTORS,
    carrying,
    grey,
    iq,
    rf,
    write_zea,
)  # fmt: skip
from scipy.spatial.transform import Rotation
from sweep_examples import frames_of, sizes_of

from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import BModeSettings, RFSettings
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.load import load_sweep, open_recording

SETTINGS = ImportSettings(bandwidth_hz=(4.5e6, 7e6), frame_rate_hz=20.0)
PLACES = "data/beamformed_data/coordinates"


def test_rf_with_coordinates(tmp_path):
    between = np.full((FRAMES, 3), 0.01)
    between[1] = np.nan  # the next frame has no time
    scan = {"time_to_next_transmit": between, "bandwidth_percent": 50}
    sweep = load_sweep(write_zea(tmp_path / "a.hdf5", rf(), scan=scan))
    np.testing.assert_array_equal(frames_of(sweep), np.delete(rf(), 2, axis=0))
    expected = ImageGrid(VECTORS, SAMPLES, PITCH_MM, SPACING_MM, FIRST_MM)
    assert sizes_of(sweep.grid) == pytest.approx(sizes_of(expected), rel=1e-6)  # single precision of metres
    rate = sweep.signal.sampling_rate_hz
    assert rate == pytest.approx(1480e3 / (2 * SPACING_MM), rel=1e-6)
    assert sweep.signal == RFSettings(rate, 1480.0, 6e6, (4.5e6, 7.5e6))
    np.testing.assert_allclose(sweep.frame_time_s, [0, 0.03, 0.09], rtol=1e-6)
    assert (sweep.probe, sweep.name) == ("L11-4v", "a")


@pytest.mark.parametrize("radius_mm", [0.0, 40.0])
def test_coordinates_on_a_polar_grid_are_the_lines_of_a_fan(tmp_path, radius_mm):
    path = write_zea(tmp_path / "a.hdf5", rf(), scan={"bandwidth_percent": 50})
    angle, along = np.linspace(-0.3, 0.2, VECTORS), radius_mm + FIRST_MM + SPACING_MM * np.arange(SAMPLES)
    places = along[:, None] * np.sin(angle), along[:, None] * np.cos(angle) - radius_mm
    with h5py.File(path, "a") as file:
        for k, place in zip((0, 2), places, strict=True):
            file[PLACES][..., k] = 1e-3 * place
    sweep = load_sweep(path, SETTINGS)
    np.testing.assert_array_equal(frames_of(sweep), rf())
    assert sweep.grid.fan.radius_mm == pytest.approx(radius_mm, abs=0.01)
    assert sweep.grid.first_sample_depth_mm == pytest.approx(FIRST_MM, abs=0.01)
    assert sweep.grid.sample_spacing_mm == pytest.approx(SPACING_MM, rel=1e-5)
    np.testing.assert_allclose(sweep.grid.angle_rad([0, VECTORS - 1]), [-0.3, 0.2], atol=1e-5)


@pytest.mark.parametrize(("carrier_hz", "middle"), [(0.0, 6e6), (6e6, 0.0), (None, None)])
def test_iq_that_carry_their_frequency_or_do_not_are_told_by_their_phase(tmp_path, carrier_hz, middle):
    frames = iq() if carrier_hz is None else carrying(carrier_hz)  # noise tells nothing
    recording = open_recording(write_zea(tmp_path / "a.hdf5", frames), SETTINGS)
    if middle is None:
        with pytest.raises(MissingSettingsError) as error:
            _ = recording.sweep
        assert error.value.settings == ("demodulation_frequency_hz",)
        return
    np.testing.assert_array_equal(frames_of(recording.sweep), frames)
    assert recording.sweep.signal.demodulation_frequency_hz == middle


@pytest.mark.parametrize("decibels", [False, True])
def test_amplitudes_and_decibels_become_grey_levels(tmp_path, decibels):
    amplitude = np.abs(iq())
    amplitude[0, 0, 0] = 0.0
    with np.errstate(divide="ignore"):
        levels = 20 * np.log10(amplitude / amplitude.max())
    kind = "image" if decibels else "envelope_data"
    path = write_zea(tmp_path / "a.hdf5", (levels if decibels else amplitude).astype("f4"), kind)
    sweep = load_sweep(path, ImportSettings(frame_rate_hz=20.0))
    # Half a level of 80 dB is 0.16 dB.
    np.testing.assert_allclose(80 * (frames_of(sweep) / 255 - 1), np.maximum(levels, -80), atol=0.16)
    assert sweep.signal == BModeSettings(80.0)


@pytest.mark.parametrize("kind", ["quaternion_wxyz", "euler_xyz"])
def test_probe_poses_are_the_tracker(tmp_path, kind):
    """As zea 0.1.8 writes them: of the transducer's tip, in metres, y elevational and z axial."""
    places = np.array([[0.0, 1e-4 * i, 0.0] for i in range(10)])
    turns = Rotation.from_rotvec(0.01 * np.arange(10)[:, None] * [0.0, 0.0, 1.0])
    rotation = turns.as_euler("xyz") if kind == "euler_xyz" else turns.as_quat(scalar_first=True)
    path = write_zea(
        tmp_path / "a.h5", grey(), "image", scan={"time_to_next_transmit": np.full((4, 2), 0.05)}
    )
    places[3] = np.nan  # a lost pose
    with h5py.File(path, "a") as file:
        group = file.create_group("metadata/probe_pose")
        group["translation"], group["rotation"] = places.astype("f4"), rotation.astype("f4")
        group["rotation_representation"] = [kind] if kind.startswith("euler") else kind
        group["start_time_offset"], group["sampling_frequency"] = np.float32(-0.1), np.float32(20.0)
    recording = open_recording(path, ImportSettings(dynamic_range_db=60.0))
    tracker = recording.sweep.tracker
    np.testing.assert_allclose(tracker.readings.time_s, -0.1 + 0.05 * np.delete(np.arange(10), 3), atol=1e-6)
    image = tracker.world_from_image(recording.sweep.frame_time_s)
    # A step along zea's y is one against the image's normal.
    np.testing.assert_allclose(np.diff(image.translation[:, 1]), 0.2, atol=0.02)
    np.testing.assert_allclose(
        image[0].rotation.as_matrix()[:, 2], [np.sin(0.02), -np.cos(0.02), 0], atol=1e-5
    )
    left_mm = np.linalg.norm(tracker.sensor_from_image.translation)
    assert left_mm == pytest.approx(PITCH_MM * (VECTORS - 1) / 2, abs=1e-6)
