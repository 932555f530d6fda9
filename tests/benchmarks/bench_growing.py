"""A recording killed at random moments: what was appended before is read, whole and in order.

Run: ``python tests/benchmarks/bench_growing.py [--kills 200] [--seed 1]`` (some minutes). Each kill: a
process writes frames as fast as it can and counts them; SIGKILL at a time drawn evenly from zero to
`LONGEST_S`. Then the sweep must be read, hold at least the frames counted, and each must be the one that
was written.
"""

import random
import tempfile
import time
from multiprocessing import get_context
from pathlib import Path

import bench
import numpy as np
import sweep_examples

from speckle3d.core.sweep import stored_dtype
from speckle3d.io.family.sweep_writer import GrowingSweep
from speckle3d.io.load import load_sweep, open_recording

LONGEST_S = 0.6
KINDS = (
    (sweep_examples.rf_sweep(frames=2, vectors=40, samples=500), None),
    (sweep_examples.rf_sweep(frames=2, vectors=40, samples=500), "gzip"),
    (sweep_examples.iq_sweep(frames=2), None),
    (sweep_examples.bmode_sweep(frames=2), "gzip"),
)
FORK = get_context("fork")


def frame(sweep, i):
    """Frame number `i`, of few values as the first two are."""
    return np.roll(sweep.frames[i % 2], i, axis=1)


def write(path, sweep, compression, count):
    """Write until killed; what is counted is in the file."""
    with GrowingSweep(path, sweep.grid, sweep.signal, stored_dtype(sweep.frames), compression) as growing:
        count.value = 0
        for i in range(10**6):
            growing.append(frame(sweep, i), 0.04 * i)
            count.value = i + 1


def count_until_kill(path, sweep, compression, wait_s):
    """Write in a process of its own and kill it; returns how many frames it counted."""
    count = FORK.Value("i", -1, lock=False)
    child = FORK.Process(target=write, args=(path, sweep, compression, count))
    child.start()
    while count.value < 0:
        time.sleep(1e-3)
    time.sleep(wait_s)
    child.kill()
    child.join()
    return count.value


def check(path, sweep, count):
    """Fail where what was left is not what was written."""
    read = load_sweep(path)
    assert len(read) >= count
    assert open_recording(path).notes, "nothing says that it was not closed"
    for i in range(len(read)):
        np.testing.assert_array_equal(read.frames[i], frame(sweep, i))
    np.testing.assert_allclose(read.frame_time_s, 0.04 * np.arange(len(read)))


def main():
    parser = bench.parser_of(__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = bench.parse_options(parser, kills=8)
    rng, frames = random.Random(options.seed), 0
    with tempfile.TemporaryDirectory() as folder:
        for k in range(options.kills):
            sweep, compression = KINDS[k % len(KINDS)]
            path = Path(folder) / f"{k}.h5"
            count = count_until_kill(path, sweep, compression, rng.uniform(0, LONGEST_S))
            if count:  # nothing can be read before the first
                check(path, sweep, count)
            frames += count
            path.unlink(missing_ok=True)
    print(f"{options.kills} kills, seed {options.seed}: all {frames} frames counted were there and right")


if __name__ == "__main__":
    main()
