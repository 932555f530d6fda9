"""Jobs for worker processes. They find this module by name, which they could not a test's own."""

import os
import signal
import time
from pathlib import Path

from speckle3d.study.images import Strip
from speckle3d.study.sweepjob import BlockJob, run_task


def double(number):
    return 2 * number


def noted(job):
    """Write down who runs it, and wait for leave to finish."""
    folder, number = job
    with open(folder / f"{number}.runs", "a") as runs:
        runs.write(f"{os.getpid()}\n")
    while not (folder / f"{number}.go").exists():
        time.sleep(0.02)
    return number


def part_of_study(task, folder, dies_at=None):
    """A study's job that writes down that it is run; at some frame its process dies, the first time."""
    name = f"block-{task.block.first}" if isinstance(task, BlockJob) else task.name
    note(folder, name)
    if dies_at is not None:
        Strip.keep = dying(Strip.keep, dies_at, Path(folder) / "died")
    return run_task(task)


def note(folder, name):
    with open(Path(folder) / f"{name}.runs", "a") as runs:
        runs.write(f"{os.getpid()}\n")


def dying(keep, frame, mark):
    def kept(strip, index, intensity):
        if index == frame and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        keep(strip, index, intensity)

    return kept


def suicide(number):
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def lost(job, reason):
    return reason
