from dataclasses import replace

import h5py
import numpy as np
import pytest
import sweep_examples

from speckle3d.core.errors import FileError
from speckle3d.core.grid import ImageGrid
from speckle3d.io.family.sweep_writer import attach_orientation, write_sweep
from speckle3d.io.load import load_sweep
from speckle3d.io.plus.write import write_sequence


@pytest.fixture
def path(tmp_path):
    target = tmp_path / "sweep.h5"
    write_sweep(target, sweep_examples.rf_sweep())
    return target


def test_a_file_written_by_hand_from_the_description_is_read(tmp_path):
    with h5py.File(tmp_path / "s.h5", "w") as file:
        file.attrs.update(format=np.bytes_(b"speckle3d.sweep"), version=1)
        rf = file.create_dataset("rf", data=np.arange(24, dtype=">i2").reshape(2, 3, 4))
        rf.attrs.update(sampling_rate_hz=40_000_000, vector_pitch_mm=[0.3], speed_of_sound_m_s=1540.0)
        rf.attrs.update(first_sample_depth_mm=0, centre_frequency_hz=6e6, bandwidth_hz=[4e6, 8e6])
        file["frame_time_s"] = [0.0, 0.04]
        file["orientation/time_s"] = [0.0, 0.01]
        file["orientation/quaternion_wxyz"] = [[1, 0, 0, 0], [1, 0, 0, 0]]
        file["tracker/time_s"] = [0.0, 0.01, 0.02]
        file["tracker/world_from_sensor"] = np.stack([np.eye(4), np.full((4, 4), np.nan), np.eye(4)])
        file["tracker/valid"] = np.array([1, 0, 1], dtype=np.uint8)
    sweep = load_sweep(tmp_path / "s.h5")
    np.testing.assert_array_equal(sweep_examples.frames_of(sweep), np.arange(24).reshape(2, 3, 4))
    assert sweep.orientation.time_offset_s == 0.0
    assert sweep.orientation.sensor_from_image is None
    np.testing.assert_array_equal(sweep.tracker.readings.time_s, [0.0, 0.02])
    assert sweep.truth is None


def test_reading_a_frame_touches_no_other(path):
    write_sweep(path, sweep_examples.rf_sweep(), compression="gzip")
    with h5py.File(path) as file:
        chunks = [file["rf"].id.get_chunk_info(i) for i in range(6)]
    content = bytearray(path.read_bytes())
    for chunk in chunks[:3] + chunks[4:]:
        content[chunk.byte_offset : chunk.byte_offset + chunk.size] = b"\xff" * chunk.size
    path.write_bytes(bytes(content))
    sweep = load_sweep(path)
    np.testing.assert_array_equal(sweep.frames[3], sweep_examples.rf_sweep().frames[3])
    with pytest.raises(FileError, match=r"frame 2: cannot be read"):
        sweep.frames[2]


def test_attaching_a_sensor_changes_nothing_else(path, tmp_path):
    with h5py.File(path, "r+") as file:
        file["annotations/landmarks_mm"] = np.eye(3)
        file.attrs["operator_note"] = "left arm"
    sweep = load_sweep(path)
    attach_orientation(path, replace(sweep.orientation, time_offset_s=0.5))
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["annotations/landmarks_mm"], np.eye(3))
    changed = load_sweep(path)
    assert (changed.orientation.time_offset_s, changed.grid) == (0.5, sweep.grid)
    np.testing.assert_array_equal(changed.frames[5], sweep.frames[5])
    write_sweep(tmp_path / "again.h5", replace(changed, tracker=None))
    with h5py.File(tmp_path / "again.h5") as file:
        np.testing.assert_array_equal(file["annotations/landmarks_mm"], np.eye(3))
        assert file.attrs["operator_note"] == "left arm"
        assert "tracker" not in file
    assert sorted(tmp_path.iterdir()) == [tmp_path / "again.h5", path]


def test_a_fan_of_vectors_is_stored_whole(tmp_path):
    flat = sweep_examples.rf_sweep()
    spacing = flat.grid.sample_spacing_mm
    fan = ImageGrid.of_fan(flat.grid.vectors, flat.grid.samples, spacing, 60.0, (-0.05, 0.1), 1.0)
    write_sweep(tmp_path / "s.h5", replace(flat, grid=fan))
    assert load_sweep(tmp_path / "s.h5").grid == fan
    with h5py.File(tmp_path / "s.h5") as file:
        assert file.attrs["version"] == 3


@pytest.mark.parametrize("name", ["s.h5", "s.mha"])
def test_images_beside_the_middle_stay_there(tmp_path, name):
    sweep = sweep_examples.rf_sweep()
    aside = replace(sweep, grid=replace(sweep.grid, first_vector_mm=5.0))
    write = write_sweep if name.endswith(".h5") else write_sequence
    write(tmp_path / name, aside)
    back = load_sweep(tmp_path / name)
    corners_mm = [
        placement.tracker.sensor_from_image.apply(np.append(placement.grid.mm(0, 0), 0.0))
        for placement in (aside, back)
    ]
    np.testing.assert_allclose(corners_mm[1], corners_mm[0], atol=1e-9)
