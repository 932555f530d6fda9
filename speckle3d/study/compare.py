"""Compare modes over many sweeps, and write a study's folder: what ``speckle3d compare`` does.

Every sweep is one job with a folder of its own, which appears whole or not at all under a name that holds a
hash of everything that determines its content. Before a long sweep come jobs for blocks of its frames, whose
results are kept in ``blocks/`` until the sweep is done. A study started again finds folders and blocks and
skips what they hold; of a worker that is killed only the unfinished job is lost.
"""

from __future__ import annotations

import shutil
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from speckle3d.config import Config
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.correction.modes import DRIFT_MODES
from speckle3d.io.curves import read_curves
from speckle3d.io.hdf5 import make_folder
from speckle3d.scoring.references import require_reference
from speckle3d.study import sweepjob
from speckle3d.study.folder import named, only_run
from speckle3d.study.request import SUBSET
from speckle3d.study.results import Study, SweepOutcome, require_own_study, write_study
from speckle3d.study.schedulers import InProcess, Scheduler
from speckle3d.study.sweepjob import BlockOutcome, SweepJob

MATCHING_SHARE = 0.5
"""Share of a sweep's time that matching its blocks takes: half with frames of 127 x 3818 samples, less with
small ones."""

KNOWN_MODES = ("image", SUBSET, *DRIFT_MODES)


@dataclass
class StudyProgress:
    """How far a study is, and how long the rest will take judging by what is finished."""

    sweeps: int
    frames: int
    done: int = 0
    failed: int = 0
    done_frames: float = 0.0
    remaining_s: float | None = None
    blocks: int = 0
    _rates: list[float] = field(default_factory=list)
    _matched: dict[str, float] = field(default_factory=lambda: defaultdict(float))

    def add(self, outcome: SweepOutcome | BlockOutcome, workers: int) -> None:
        """Count a finished sweep or block; skipped and failed ones do not count for the time left."""
        work = float(outcome.frames)
        if isinstance(outcome, BlockOutcome):
            work *= MATCHING_SHARE
            self.blocks -= 1
            self._matched[outcome.name] += work
            self.done_frames += work
        else:
            self.done += 1
            self.failed += outcome.status == "failed"
            self.done_frames += work - self._matched.pop(outcome.name, 0.0)
        if work > 0 and not (outcome.reason or outcome.skipped):
            self._rates.append(outcome.seconds / work)
        if self.done == self.sweeps:
            self.remaining_s = 0.0
        elif self._rates:
            running = max(1, min(workers, self.sweeps - self.done + self.blocks))
            self.remaining_s = float(np.median(self._rates)) * (self.frames - self.done_frames) / running


def compare_sweeps(
    paths: Sequence[Path],
    directory: Path,
    modes: Sequence[str] | None = None,
    reference: str | None = None,
    curves: Path | None = None,
    config: Config | None = None,
    calibrations: Sequence[Path] = (),
    scheduler: Scheduler | None = None,
    progress: Callable[[StudyProgress], None] | None = None,
) -> Study:
    """Reconstruct sweeps in every mode, compare the modes, and write it all into `directory`.

    Written: ``study.json``, ``table.txt``, ``table.csv``, and a folder for each sweep with what `run_job`
    writes. A sweep that cannot be done is one entry that says why. A sweep whose folder is there, from the
    same input, settings and version, is not done again.

    Parameters
    ----------
    modes : sequence of str, optional
        Beside `image`; by default all that each sweep has sensors for. "crossed" takes for the
        crossing sweep of ``SWEEP.h5`` the file ``SWEEP-crossing.h5`` beside it.
    curves : path, optional
        Decorrelation curves; by default curves.h5 beside each sweep.
    progress : callable, optional
        Called at the beginning and after each sweep, and each block of a long one.

    Raises
    ------
    InvalidInputError, InsufficientDataError
        If a setting is wrong for all sweeps, or none can be compared.
    FileError
        If the folder cannot be written, or another run is at work in it.
    """
    if not paths:
        raise InvalidInputError("expected at least one sweep, got none")
    chosen = None if modes is None else tuple(dict.fromkeys(modes))
    # What is wrong for one sweep is wrong for all: refused before any work is done.
    for mode in chosen or ():
        if mode not in KNOWN_MODES:
            raise InvalidInputError(f"expected a mode among {', '.join(KNOWN_MODES)}; got {mode!r}")
    require_reference(reference)
    require_own_study(directory)
    if curves is not None:
        read_curves(curves)
    where, settings = scheduler or InProcess(), (config or Config()).to_toml()
    plan = [
        sweepjob.plan_sweep(name, path, directory, curves, settings, chosen, reference, tuple(calibrations))
        for name, path in named(paths)
    ]
    jobs = [each for each in plan if isinstance(each, SweepJob)]
    outcomes = {each.name: each for each in plan if isinstance(each, SweepOutcome)}
    if not jobs:
        why = next(iter(outcomes.values()))
        raise InsufficientDataError(
            f"expected a sweep that can be compared, got none of {len(plan)}; {why.name}: {why.reason}"
        )
    with only_run(directory):
        outcomes |= _run(jobs, where, directory, progress)
        return write_study(directory, [outcomes[each.name] for each in plan], settings)


def _run(
    jobs: Sequence[SweepJob],
    where: Scheduler,
    directory: Path,
    progress: Callable[[StudyProgress], None] | None,
) -> dict[str, SweepOutcome]:
    """Do all jobs; outcomes by name."""
    outcomes: dict[str, SweepOutcome] = {}
    folders = directory / "sweeps"
    make_folder(folders)
    # This process holds the study: none but a killed run has left these.
    for part in folders.glob(".part-*"):
        shutil.rmtree(part, ignore_errors=True)
    by_name = {job.name: job for job in jobs}
    # The longest first, so that no worker is left with it while the others have nothing to do.
    tasks, after = _tasks(sorted(jobs, key=lambda job: job.frames, reverse=True))
    so_far = StudyProgress(len(jobs), sum(job.frames for job in jobs), blocks=len(tasks) - len(jobs))
    tell = progress or (lambda at: None)
    tell(so_far)
    try:
        for _, outcome in where.run(sweepjob.run_task, tasks, sweepjob.lost_task, after):
            if isinstance(outcome, SweepOutcome):
                outcome = outcomes[outcome.name] = _require_here(outcome, by_name[outcome.name])
            so_far.add(outcome, where.workers)
            tell(so_far)
    except BaseException:
        _clear(jobs)
        with suppress(OSError):  # it holds finished sweeps
            folders.rmdir()
        raise
    _clear(jobs)
    return outcomes


def _tasks(jobs: Sequence[SweepJob]) -> tuple[list[sweepjob.Task], dict[int, range]]:
    """All jobs, and which come after which: a long sweep's job comes after those of its blocks."""
    tasks: list[sweepjob.Task] = []
    after: dict[int, range] = {}
    for job in jobs:
        blocks = sweepjob.plan_blocks(job)
        after[len(tasks) + len(blocks)] = range(len(tasks), len(tasks) + len(blocks))
        tasks += [*blocks, job]
    return tasks, after


def _require_here(outcome: SweepOutcome, job: SweepJob) -> SweepOutcome:
    """Fail a sweep whose results a worker wrote to a disk that this process does not see."""
    if outcome.status == "done" and sweepjob.finished(job) is None:
        return sweepjob.lost(
            job, f"{job.folder}: expected a folder that workers and the study share, got none here"
        )
    return outcome


def _clear(jobs: Sequence[SweepJob]) -> None:
    """Remove what killed workers left of this study's own sweeps."""
    for job in jobs:
        for part in job.folder.parent.glob(f".part-*-{job.folder.name}"):
            shutil.rmtree(part, ignore_errors=True)
        blocks = sweepjob.block_files(job).folder
        for part in blocks.glob(".part-*"):
            part.unlink(missing_ok=True)
        with suppress(OSError):
            blocks.parent.rmdir()
