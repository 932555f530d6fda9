"""A study of many small sweeps on two workers beside one."""

from bench_compare import seconds_by_workers

from speed.rows import Row

TARGET = 0.55
SWEEPS, FRAMES = 16, 60


def rows() -> list[Row]:
    """Time on two workers over that on one, the start of the processes included."""
    seconds = seconds_by_workers(SWEEPS, FRAMES)
    what = f"study of {SWEEPS} sweeps, two workers: time over one worker's {seconds[1]:.0f} s"
    return [Row(what, seconds[2] / seconds[1], "", "half", 0.5, TARGET, falling=True)]
