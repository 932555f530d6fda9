"""A study of many small sweeps on two workers beside one."""

import tempfile
from pathlib import Path

from bench_compare import short_study, timed

from speed.rows import Row

TARGET = 0.55


def rows() -> list[Row]:
    """Time on two workers over that on one; workers are there already, and have done one sweep each."""
    paths, warm, config = short_study(frames=60)
    with tempfile.TemporaryDirectory() as folder:
        one, two = (
            timed(paths, warm, config, Path(folder) / str(workers), workers, kill=False)[0]
            for workers in (1, 2)
        )
    what = f"study of {len(paths)} sweeps, two workers: time over one worker's {one:.0f} s"
    return [Row(what, two / one, "", "half", 0.5, TARGET, falling=True)]
