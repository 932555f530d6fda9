"""A recording killed at random moments: what was appended before is read, whole and in order.

Run: ``python tests/benchmarks/bench_growing.py [KILLS] [SEED]`` (200 and 1; some minutes). Each kill: a
process writes frames as fast as it can and says after each how many there are; SIGKILL at a time drawn evenly
from zero to `LONGEST_S`. Then the sweep must be read, hold at least the frames that were told of, and each
must be the one that was written.
"""

import os
import random
import signal
import struct
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import sweep_examples

from speckle3d.core.errors import Speckle3DError
from speckle3d.io.load import load_sweep, open_recording
from speckle3d.io.sweep_writer import GrowingSweep

LONGEST_S = 0.6
KINDS = (
    (sweep_examples.rf_sweep(frames=2, vectors=40, samples=500), None),
    (sweep_examples.rf_sweep(frames=2, vectors=40, samples=500), "gzip"),
    (sweep_examples.iq_sweep(frames=2), None),
    (sweep_examples.bmode_sweep(frames=2), "gzip"),
)


def frame(sweep, i):
    """Frame number `i`, of few values as the first two are."""
    return np.roll(sweep.frames[i % 2], i, axis=1)


def write(path, sweep, compression, told):
    """Write until killed; what is told is in the file."""
    dtype = getattr(sweep.frames, "stored_dtype", sweep.frames.dtype)
    with GrowingSweep(path, sweep.grid, sweep.signal, dtype, compression) as growing:
        os.write(told, struct.pack("i", 0))
        for i in range(10**6):
            growing.append(frame(sweep, i), 0.04 * i)
            os.write(told, struct.pack("i", i + 1))


def killed(path, sweep, compression, wait_s):
    """Write in a process of its own and kill it; returns how many frames it told of."""
    reading, told = os.pipe()
    child = os.fork()
    if not child:
        os.close(reading)
        write(path, sweep, compression, told)
        os._exit(0)
    os.close(told)
    os.read(reading, 4)
    time.sleep(wait_s)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    count = 0
    while said := os.read(reading, 4 * 4096):
        count = struct.unpack("i", said[-4:])[0]
    os.close(reading)
    return count


def faults(path, sweep, count):
    """What is wrong with what was left."""
    try:
        read = load_sweep(path)
    except Speckle3DError as error:
        return "nothing yet" if count == 0 else f"{count} frames: {error}"
    wrong = []
    if not len(read) >= count:
        wrong.append(f"{count} frames, got {len(read)}")
    if not open_recording(path).notes:
        wrong.append("nobody says that it was not closed")
    if any(not np.array_equal(read.frames[i], frame(sweep, i)) for i in range(len(read))):
        wrong.append("another frame")
    np.testing.assert_allclose(read.frame_time_s, 0.04 * np.arange(len(read)))
    read.frames.close()
    return "; ".join(wrong)


def main(kills=200, seed=1):
    """Kill so often; returns how often something was wrong."""
    drawn, found, bad = random.Random(seed), Counter(), 0
    with tempfile.TemporaryDirectory() as folder:
        for k in range(kills):
            sweep, compression = KINDS[k % len(KINDS)]
            path = Path(folder) / f"{k}.h5"
            count = killed(path, sweep, compression, drawn.uniform(0, LONGEST_S))
            wrong = faults(path, sweep, count)
            found[wrong or "whole"] += 1
            bad += bool(wrong) and wrong != "nothing yet"
            found["frames"] += count
            path.unlink(missing_ok=True)
    print(f"{kills} kills, seed {seed}: " + ", ".join(f"{n} {what}" for what, n in sorted(found.items())))
    return bad


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
