"""Writing a sweep file of 1 GB against `shutil.copyfile` of it in the same process, in processor time.

Run: ``python tests/benchmarks/bench_convert.py [GIGABYTES] [FOLDER]``. Frames are those of
``data/phantom.h5`` over and over, as int16 RF without compression; then 0.1 GB with gzip and lzf. Processor
time, since the disk and other programs decide the rest. The peak is this process's resident memory.
"""

import os
import resource
import shutil
import sys
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from speckle3d.io.load import load_sweep
from speckle3d.io.sweep_writer import COMPRESSIONS, write_sweep

SOURCE = Path(__file__).resolve().parents[2] / "data" / "phantom.h5"
AIM = 0.7


class Repeated:
    """Some frames in memory, over and over."""

    def __init__(self, frames, count):
        self.frames, self.shape, self.dtype = frames, (count, *frames[0].shape), frames[0].dtype

    def __getitem__(self, index):
        return self.frames[range(self.shape[0])[index] % len(self.frames)]


def seconds(work, out):
    """Processor time of making a new file, the system's included."""
    out.unlink(missing_ok=True)
    before = os.times()
    work()
    after = os.times()
    return after.user + after.system - before.user - before.system


def main(gigabytes=1.0, folder=None):
    sweep = load_sweep(SOURCE)
    frames = [sweep.frames[i] for i in range(24)]
    count = round(float(gigabytes) * 1e9 / frames[0].nbytes)
    bare = replace(sweep, orientation=None, tracker=None, truth=None)
    with tempfile.TemporaryDirectory(dir=folder) as made:
        whole, part, out = (Path(made) / name for name in ("whole.h5", "part.h5", "out.h5"))
        for path, n in ((whole, count), (part, max(count // 10, 1))):
            write_sweep(path, replace(bare, frames=Repeated(frames, n), frame_time_s=np.arange(n) / 25))
        ratios = []
        for _ in range(5):
            copied = seconds(lambda: shutil.copyfile(whole, out), out)
            ratios.append(copied / seconds(lambda: write_sweep(out, load_sweep(whole)), out))
        print(f"{gigabytes} GB: {np.median(ratios):.2f} of copyfile's speed (aim: {AIM})")
        for word, compression in COMPRESSIONS.items():
            packed = partial(write_sweep, out, load_sweep(part), None, compression)
            spent = seconds(packed, out)
            size = part.stat().st_size
            print(f"{word}: {size / 1e6 / spent:.0f} MB/s, {out.stat().st_size / size:.2f} of the size")
    print(f"peak memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB")
    return np.median(ratios) < AIM


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
