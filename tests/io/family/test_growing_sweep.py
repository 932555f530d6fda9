"""A sweep that grows: read at any moment, after a kill, and when closed."""

import subprocess
import sys

import numpy as np
import pytest
import sweep_examples

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.sweep import stored_dtype
from speckle3d.io.family.sweep_writer import GrowingSweep
from speckle3d.io.load import load_sweep, open_recording

SWEEPS = {
    "rf": sweep_examples.rf_sweep(),
    "iq": sweep_examples.iq_sweep(),
    "bmode": sweep_examples.bmode_sweep(),
}


def growing(path, sweep, compression=None, **options):
    return GrowingSweep(path, sweep.grid, sweep.signal, stored_dtype(sweep.frames), compression, **options)


@pytest.mark.parametrize(("kind", "compression"), [("rf", None), ("iq", "gzip"), ("bmode", None)])
def test_frames_are_read_while_a_file_grows_and_when_it_is_whole(tmp_path, kind, compression):
    sweep, path = SWEEPS[kind], tmp_path / "s.h5"
    with growing(path, sweep, compression) as target:
        for i in range(2):
            target.append(sweep.frames[i], sweep.frame_time_s[i])
            sweep_so_far = load_sweep(path)
            assert len(sweep_so_far) == len(target) == i + 1
            np.testing.assert_array_equal(sweep_so_far.frames[i], sweep.frames[i])
            assert (sweep_so_far.tracker, sweep_so_far.orientation) == (None, None)
            assert f"{i + 1} frames so far" in open_recording(path).notes[0]
    assert not any("frames" in note for note in open_recording(path).notes)


WRITER = """
import sys
sys.path[:0] = sys.argv[2:]
import sweep_examples
from speckle3d.io.family.sweep_writer import GrowingSweep
sweep = sweep_examples.rf_sweep()
with GrowingSweep(sys.argv[1], sweep.grid, sweep.signal, "int16") as target:
    for frame, time_s in zip(sweep.frames, sweep.frame_time_s):
        target.append(frame, time_s)
        print("frame", flush=True)
        sys.stdin.readline()
"""


def test_another_process_sees_it_grow_whatever_it_still_holds(tmp_path):
    sweep, path, earlier = SWEEPS["rf"], tmp_path / "s.h5", []
    command = [sys.executable, "-c", WRITER, str(path), *sys.path]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as writer:
        for i in range(3):
            assert writer.stdout.readline() == "frame\n"
            earlier.append(load_sweep(path))
            np.testing.assert_array_equal(earlier[-1].frames[i], sweep.frames[i])
            writer.stdin.write("\n")
            writer.stdin.flush()
        writer.kill()


def test_a_file_that_is_there_stays_as_it_is(tmp_path):
    (tmp_path / "s.h5").write_text("mine")
    with pytest.raises(FileError, match="there already"), growing(tmp_path / "s.h5", SWEEPS["rf"]):
        pass
    assert (tmp_path / "s.h5").read_text() == "mine"


def test_an_error_leaves_nothing_in_the_file_and_the_recording_goes_on(tmp_path):
    sweep, path = SWEEPS["rf"], tmp_path / "s.h5"
    with growing(path, sweep, probe="L14") as target:
        target.append(sweep.frames[0], 10.0)
        target.append_reading("tracker", 9.0, np.eye(4))
        for append in (
            lambda: target.append_reading("tracker", 9.0, np.eye(4)),
            lambda: target.append(sweep.frames[1], 10.0),
        ):
            with pytest.raises(InvalidInputError):
                append()
        target.append(sweep.frames[1], 12.0)
    sweep_so_far = load_sweep(path)
    assert (sweep_so_far.probe, sweep_so_far.frame_time_s.tolist()) == ("L14", [10.0, 12.0])
    assert len(sweep_so_far.tracker.readings) == 1
