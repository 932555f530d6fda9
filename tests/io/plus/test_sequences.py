"""Sweeps written as sequences are read back equal, by this package and by others."""

from dataclasses import replace

import numpy as np
import pytest
import sweep_examples
from image_examples import grey, write_mha

from speckle3d.io.family.sweep_writer import write_sweep
from speckle3d.io.images.headers import read_header
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import load_sweep, open_recording
from speckle3d.io.plus.write import write_sequence

RF = ImportSettings(
    sampling_rate_hz=40e6,
    vector_pitch_mm=0.3,
    centre_frequency_hz=6e6,
    bandwidth_hz=(4e6, 8e6),
    demodulation_frequency_hz=0.0,
)


@pytest.mark.parametrize("make", [sweep_examples.bmode_sweep, sweep_examples.rf_sweep])
@pytest.mark.parametrize(
    ("suffix", "compress"),
    [(".mha", True), (".seq.nrrd", False)],
)
def test_a_sweep_with_sensors_is_interpolated_at_its_frames(tmp_path, make, suffix, compress):
    sweep = make()
    omissions = write_sequence(tmp_path / f"out{suffix}", sweep, compressed=compress)
    assert len(omissions) == 3  # readings of both sensors between frames, and the truth
    back = load_sweep(tmp_path / f"out{suffix}")  # nothing is asked for
    for i in range(len(sweep)):
        np.testing.assert_array_equal(back.frames[i], sweep.frames[i])
    assert back.frames.dtype == sweep.frames.dtype
    assert (back.signal, back.grid, back.probe) == (sweep.signal, sweep.grid, sweep.probe)
    np.testing.assert_array_equal(back.frame_time_s, sweep.frame_time_s)
    for ours, expected in ((back.tracker, sweep.tracker), (back.orientation, sweep.orientation)):
        reach = expected.covers(sweep.frame_time_s)
        assert 0 < reach.sum() < len(sweep)  # the sensors end before the last frame
        np.testing.assert_array_equal(ours.readings.time_s, sweep.frame_time_s[reach])
        # Poses go through their matrices of doubles.
        np.testing.assert_allclose(
            ours.world_from_image(sweep.frame_time_s[reach]).as_matrix(),
            expected.world_from_image(sweep.frame_time_s[reach]).as_matrix(),
            atol=1e-9,
        )


@pytest.mark.parametrize("kind", ["RF_REAL", "RF_IQ_LINE", "RF_I_LINE_Q_LINE"])
@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_echoes_survive_a_sequence_and_a_sweep_file(tmp_path, kind, dtype):
    values = np.random.default_rng(3).integers(-3000, 3000, (2, 6, 8)).astype(dtype)
    path = write_mha(tmp_path / "in.mha", values, {"UltrasoundImageType": kind})
    sweep = load_sweep(path, RF)
    write_sweep(tmp_path / "a.h5", sweep)
    write_sequence(tmp_path / "out.mha", load_sweep(tmp_path / "a.h5"))
    again = load_sweep(tmp_path / "out.mha")
    np.testing.assert_array_equal(again.frames[1], sweep.frames[1])
    assert (again.grid, again.signal) == (sweep.grid, sweep.signal)
    assert read_header(tmp_path / "out.mha").dtype == dtype


def test_a_skewed_calibration_survives_a_sweep_file_and_a_sequence(tmp_path):
    """ImageToProbe of PLUS's spine phantom, whose axes lean by 2.7 degrees."""
    matrix = np.eye(4)
    matrix[:3] = [
        [-0.00157821, 0.0785919, -0.00803285, 15.3978],
        [-0.0839128, 0.00372697, 0.0153803, 49.5705],
        [0.0159024, 0.00714276, 0.0803604, -8.63446],
    ]
    frames = [
        {"Timestamp": f"{i / 20}", "ProbeToTrackerTransform": "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"}
        for i in range(3)
    ]
    path = write_mha(tmp_path / "a.mha", grey(), frames=frames)
    settings = ImportSettings(dynamic_range_db=60.0, image_to_probe=tuple(map(tuple, matrix)))
    sweep = load_sweep(path, settings)
    assert np.rad2deg(sweep.tracker.image_skew_rad) == pytest.approx(-2.745, abs=1e-3)
    assert any("ImageToProbe * ProbeToTracker" in note for note in open_recording(path, settings).notes)
    grid = replace(sweep.grid, skew_rad=sweep.tracker.image_skew_rad)
    pixel_places = sweep.tracker.sensor_from_image.as_matrix() @ grid.image_from_sample
    np.testing.assert_allclose(pixel_places, matrix[:, [0, 1, 3]], atol=1e-9)
    write_sweep(tmp_path / "a.h5", sweep)
    copy = load_sweep(tmp_path / "a.h5")
    write_sequence(tmp_path / "b.mha", copy)
    back = load_sweep(tmp_path / "b.mha").tracker
    assert back.image_skew_rad == pytest.approx(sweep.tracker.image_skew_rad, abs=1e-9)
    np.testing.assert_allclose(
        back.sensor_from_image.as_matrix(), sweep.tracker.sensor_from_image.as_matrix(), atol=1e-9
    )


@pytest.mark.parametrize("name", ["ImageToRoom", "RoomToImage"])
def test_poses_may_be_those_of_the_image_s_pixels(tmp_path, name):
    """Slicer and PLUS record ImageToReference, from pixels to mm."""
    pixels = np.array([[0.1, 0.008, 0, 0], [0, 0.2, 0, 0], [0, 0, 0.15, 0], [0, 0, 0, 1]])
    matrices = sweep_examples.poses(4).as_matrix() @ pixels
    file_matrices = matrices if name == "ImageToRoom" else np.linalg.inv(matrices)
    frames = [
        {
            "Timestamp": f"{5 + 0.1 * i}",
            f"{name}Transform": " ".join(map(repr, file_matrices[i].ravel().tolist())),
        }
        for i in range(4)
    ]
    frames[3][f"{name}TransformStatus"] = "INVALID"
    path = write_mha(tmp_path / "a.mha", grey(4), frames=frames)
    settings = ImportSettings(
        dynamic_range_db=60.0, tracker_transform="ImageToRoom", first_sample_depth_mm=2.0
    )
    sweep = load_sweep(path, settings)
    assert len(sweep.tracker.readings) == 3
    grid = replace(sweep.grid, skew_rad=sweep.tracker.image_skew_rad)
    pixel_places = sweep.tracker.world_from_image(sweep.frame_time_s[:3]).as_matrix() @ grid.image_from_sample
    np.testing.assert_allclose(pixel_places, matrices[:3, :, [0, 1, 3]], atol=1e-9)


@pytest.mark.parametrize("compress", [True, False])
def test_itk_reads_the_same_pixels(tmp_path, compress):
    import SimpleITK

    sweep = sweep_examples.rf_sweep()
    expected = np.stack([sweep.frames[i] for i in range(len(sweep))])
    write_sequence(tmp_path / "a.mha", sweep, compressed=compress)
    image = SimpleITK.ReadImage(str(tmp_path / "a.mha"))
    np.testing.assert_array_equal(SimpleITK.GetArrayFromImage(image), expected)
