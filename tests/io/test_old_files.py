"""Files of every kind that version 0.1 wrote, at commit 8cb059c, are read as what was written."""

from dataclasses import fields, is_dataclass

import numpy as np
import old_files
import pytest

from speckle3d.core.sweep import Sweep
from speckle3d.io.calibrations import read_calibration
from speckle3d.io.curves import read_curves
from speckle3d.io.load import load_sweep
from speckle3d.io.reconstructions import read_reconstruction


def assert_same(got, expected, where=""):
    """Compare records field by field, whatever lazily read or nested they hold."""
    if isinstance(expected, Sweep):
        frames = [np.asarray(expected.frames[i]) for i in range(len(expected))]
        np.testing.assert_array_equal([got.frames[i] for i in range(len(got))], frames, where)
    if hasattr(expected, "as_matrix"):
        np.testing.assert_allclose(got.as_matrix(), expected.as_matrix(), atol=1e-12, err_msg=where)
    elif is_dataclass(expected):
        for field in fields(expected):
            is_own = field.compare and (
                field.name not in ("frames", "name") or not isinstance(expected, Sweep)
            )
            if is_own:
                assert_same(getattr(got, field.name), getattr(expected, field.name), f"{where}.{field.name}")
    elif isinstance(expected, dict):
        assert list(got) == list(expected), where
        for name, value in expected.items():
            assert_same(got[name], value, f"{where}[{name}]")
    elif isinstance(expected, tuple) and expected and is_dataclass(expected[0]):
        assert len(got) == len(expected), where
        for one, other in zip(got, expected, strict=True):
            assert_same(one, other, where)
    elif isinstance(expected, np.ndarray):
        assert got.dtype == expected.dtype, where
        np.testing.assert_array_equal(got, expected, where)
    else:
        assert got == expected, where


@pytest.mark.parametrize("name", list(old_files.sweeps()))
def test_sweeps(name):
    assert_same(load_sweep(old_files.FOLDER / f"{name}.h5"), old_files.sweeps()[name][0])


@pytest.mark.parametrize("name", list(old_files.curves()))
def test_curves(name):
    assert_same(read_curves(old_files.FOLDER / f"{name}.h5"), old_files.curves()[name])


@pytest.mark.parametrize("name", list(old_files.calibrations()))
def test_calibrations(name):
    assert_same(read_calibration(old_files.FOLDER / f"{name}.h5"), old_files.calibrations()[name])


@pytest.mark.parametrize("name", list(old_files.reconstructions()))
def test_reconstructions(name):
    assert_same(read_reconstruction(old_files.FOLDER / f"{name}.h5"), old_files.reconstructions()[name])


def assert_recording(path):
    whole, got = old_files.sweeps()["rf"][0], load_sweep(path)
    assert_same(got.grid, whole.grid)
    np.testing.assert_array_equal([got.frames[i] for i in range(len(got))], whole.frames)
    assert_same(got.frame_time_s, whole.frame_time_s)
    assert_same(got.tracker.readings.world_from_sensor, old_files.POSES[[0, 1, 3]])
    assert_same(got.orientation.readings.world_from_sensor, old_files.TURNS)


RECORDINGS = ("growing", "growing_gzip", "killed")
"""Of a live session, closed, compressed, and left by a process that was killed."""


@pytest.mark.parametrize("name", RECORDINGS)
def test_recordings(name):
    assert_recording(old_files.FOLDER / f"{name}.h5")


def test_this_version_reads_what_it_writes(tmp_path):
    """The same set, written now."""
    old_files.write_all(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in old_files.FOLDER.iterdir()}
    for name, (sweep, _) in old_files.sweeps().items():
        assert_same(load_sweep(tmp_path / f"{name}.h5"), sweep)
    for name, curves in old_files.curves().items():
        assert_same(read_curves(tmp_path / f"{name}.h5"), curves)
    for name, calibration in old_files.calibrations().items():
        assert_same(read_calibration(tmp_path / f"{name}.h5"), calibration)
    for name, reconstruction in old_files.reconstructions().items():
        assert_same(read_reconstruction(tmp_path / f"{name}.h5"), reconstruction)
    for name in RECORDINGS:
        assert_recording(tmp_path / f"{name}.h5")
