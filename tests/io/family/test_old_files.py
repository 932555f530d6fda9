"""Files of every kind that version 0.1 wrote, at commit 8cb059c, are read as what was written."""

from dataclasses import fields, is_dataclass

import numpy as np
import old_files
import pytest

from speckle3d.core.sweep import Sweep
from speckle3d.io.family.calibrations import read_calibration
from speckle3d.io.family.curves import read_curves
from speckle3d.io.family.reconstructions import read_reconstruction
from speckle3d.io.load import load_sweep


def assert_same(actual, expected, where=""):
    """Compare records field by field, whatever lazily read or nested they hold."""
    if isinstance(expected, Sweep):
        frames = [np.asarray(expected.frames[i]) for i in range(len(expected))]
        np.testing.assert_array_equal([actual.frames[i] for i in range(len(actual))], frames, where)
    if hasattr(expected, "as_matrix"):
        np.testing.assert_allclose(actual.as_matrix(), expected.as_matrix(), atol=1e-12, err_msg=where)
    elif is_dataclass(expected):
        for field in fields(expected):
            compare = field.compare and (
                field.name not in ("frames", "name") or not isinstance(expected, Sweep)
            )
            if compare:
                assert_same(
                    getattr(actual, field.name), getattr(expected, field.name), f"{where}.{field.name}"
                )
    elif isinstance(expected, dict):
        assert list(actual) == list(expected), where
        for name, value in expected.items():
            assert_same(actual[name], value, f"{where}[{name}]")
    elif isinstance(expected, tuple) and expected and is_dataclass(expected[0]):
        assert len(actual) == len(expected), where
        for a, b in zip(actual, expected, strict=True):
            assert_same(a, b, where)
    elif isinstance(expected, np.ndarray):
        assert actual.dtype == expected.dtype, where
        np.testing.assert_array_equal(actual, expected, where)
    else:
        assert actual == expected, where


RECORDINGS = ("growing", "growing_gzip", "killed")
"""Of a live session, closed, compressed, and left by a process that was killed."""
CONTENTS = (
    (load_sweep, {name: sweep for name, (sweep, _) in old_files.sweeps().items()}),
    (read_curves, old_files.curves()),
    (read_calibration, old_files.calibrations()),
    (read_reconstruction, old_files.reconstructions()),
)
FILES = {name: (read, content) for read, contents in CONTENTS for name, content in contents.items()}


@pytest.fixture(scope="module", params=["version 0.1", "this version"])
def folder(request, tmp_path_factory):
    """The set as version 0.1 wrote it, and written now."""
    if request.param == "version 0.1":
        return old_files.FOLDER
    target = tmp_path_factory.mktemp("made")
    old_files.write_all(target)
    return target


def test_the_set_is_whole(folder):
    assert {path.stem for path in folder.iterdir()} == {*FILES, *RECORDINGS}


@pytest.mark.parametrize("name", FILES)
def test_a_file_holds_its_record(folder, name):
    read, content = FILES[name]
    assert_same(read(folder / f"{name}.h5"), content)


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_recording_holds_its_frames_and_readings(folder, name):
    whole, actual = old_files.sweeps()["rf"][0], load_sweep(folder / f"{name}.h5")
    assert_same(actual.grid, whole.grid)
    np.testing.assert_array_equal([actual.frames[i] for i in range(len(actual))], whole.frames)
    assert_same(actual.frame_time_s, whole.frame_time_s)
    assert_same(actual.tracker.readings.world_from_sensor, old_files.POSES[[0, 1, 3]])
    assert_same(actual.orientation.readings.world_from_sensor, old_files.TURNS)
