"""Writing sweep files against `shutil.copyfile` in processor time: the disk decides the rest."""

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from cache import InOrder

from speckle3d.io.load import load_sweep
from speckle3d.io.sweep_writer import COMPRESSIONS, write_sweep
from speed.rows import Row, timed

SHIPPED = Path(__file__).resolve().parents[3] / "data" / "phantom.h5"
AIM = 0.7
"""Of copyfile's speed, without compression."""


def rows(runs):
    """A sweep of 1 GB of int16 RF without compression, and of 0.1 GB with each."""
    sweep = replace(load_sweep(SHIPPED), orientation=None, tracker=None, truth=None)
    frames = np.stack([sweep.frames[i] for i in range(24)])
    table = []
    with tempfile.TemporaryDirectory() as folder:
        source, out = Path(folder) / "source.h5", Path(folder) / "out.h5"
        for word, compression, size in (("none", None, 1e9), *((w, c, 1e8) for w, c in COMPRESSIONS.items())):
            index = np.arange(round(size / frames[0].nbytes)) % len(frames)
            write_sweep(
                source,
                replace(sweep, frames=InOrder(frames, index), frame_time_s=0.04 * np.arange(len(index))),
            )

            def copied():
                out.unlink(missing_ok=True)
                shutil.copyfile(source, out)

            def converted(compression=compression):
                out.unlink(missing_ok=True)
                write_sweep(out, load_sweep(source), None, compression)

            size = source.stat().st_size / 1e6
            peer, ours = (size / timed(work, runs).busy_s for work in (copied, converted))
            packed = out.stat().st_size / 1e6 / size
            what = f"write {size / 1e3:.1f} GB, compression {word}: {packed:.2f} of the size"
            target = None if compression else AIM * peer
            table.append(Row(what, ours, "MB/s", "copyfile", peer, target))
    return table
