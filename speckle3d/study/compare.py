"""Sweeps in, a study's folder out: what ``speckle3d compare`` does.

Every sweep is one job with a folder of its own, which appears whole or not at all under a name that holds a
hash of everything that determines its content. Before a long sweep come jobs for blocks of its frames, whose
results are kept in ``blocks/`` until the sweep is done. A study started again finds folders and blocks and
skips what they hold; a worker that is killed leaves nothing behind but the work it was at.
"""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from speckle3d.config import Config
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.io.curves import read_curves
from speckle3d.io.hdf5 import atomic_path, make_folder
from speckle3d.study.job import REFERENCES, SUBSET
from speckle3d.study.metrics import ModeError
from speckle3d.study.overall import over_sweeps, overall_text
from speckle3d.study.schedulers import InProcess, Scheduler, remaining_s
from speckle3d.study.summary import Summary, csv_text, plain, table_text
from speckle3d.study.sweepjob import (
    BlockJob,
    BlockOutcome,
    SweepJob,
    SweepOutcome,
    block_files,
    finished,
    lost,
    lost_block,
    plan_blocks,
    plan_sweep,
    run_block,
    run_sweep,
)

FORMAT = "speckle3d.study"
VERSION = 1
MATCHING_SHARE = 0.5
"""Of a sweep's time: half with frames of 127 x 3818 samples, less with small ones."""
Task = SweepJob | BlockJob
TaskOutcome = SweepOutcome | BlockOutcome
KNOWN_MODES = ("image", SUBSET, "orientation", "pose")


@dataclass(frozen=True)
class Study:
    """What a study found, and where it is."""

    directory: Path
    outcomes: Sequence[SweepOutcome]
    summaries: Sequence[Summary]
    drift: Sequence[Mapping[str, Any]]
    table: str


@dataclass
class StudyProgress:
    """How far a study is, and how long the rest will take by what is finished."""

    sweeps: int
    frames: int
    done: int = 0
    failed: int = 0
    done_frames: float = 0.0
    remaining_s: float | None = None
    blocks: int = 0
    _timed: list[tuple[float, float]] = field(default_factory=list)
    _matched: dict[str, float] = field(default_factory=dict)

    def add(self, outcome: SweepOutcome, frames: int, workers: int) -> None:
        """Count a finished sweep; only those that took time say how long others take."""
        self.done += 1
        self.done_frames += frames - self._matched.pop(outcome.name, 0.0)
        self.failed += outcome.status == "failed"
        if outcome.status == "done" and not outcome.skipped:
            self._timed.append((frames, outcome.seconds))
        self._look_ahead(workers)

    def add_block(self, outcome: BlockOutcome, workers: int) -> None:
        """Count a block of a sweep that is not finished, one of `blocks` that are left."""
        self.blocks -= 1
        work = MATCHING_SHARE * outcome.frames
        self._matched[outcome.name] = self._matched.get(outcome.name, 0.0) + work
        self.done_frames += work
        if not outcome.reason and not outcome.skipped:
            self._timed.append((work, outcome.seconds))
        self._look_ahead(workers)

    def _look_ahead(self, workers: int) -> None:
        running = min(workers, self.sweeps - self.done + self.blocks)
        left = self.frames - self.done_frames
        self.remaining_s = remaining_s(self._timed, left, running) if self.done < self.sweeps else 0.0


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
        Beside `image`; by default all that each sweep has sensors for.
    curves : path, optional
        Decorrelation curves; by default curves.h5 beside each sweep.
    progress : callable, optional
        Called at the beginning and after each sweep, and each block of a long one.
    """
    if not paths:
        raise InvalidInputError("expected at least one sweep, got none")
    chosen = None if modes is None else tuple(dict.fromkeys(modes))
    _require_known(chosen, reference)
    if curves is not None:
        read_curves(curves)  # wrong for one sweep is wrong for all
    where, settings = scheduler or InProcess(), (config or Config()).to_toml()
    plan = [
        plan_sweep(name, path, directory, curves, settings, chosen, reference, tuple(calibrations))
        for name, path in _named(paths)
    ]
    jobs = [each for each in plan if isinstance(each, SweepJob)]
    outcomes = {each.name: each for each in plan if isinstance(each, SweepOutcome)}
    if not jobs:
        why = next(iter(outcomes.values()))
        raise InsufficientDataError(
            f"expected a sweep that can be compared, got none of {len(plan)}; {why.name}: {why.reason}"
        )
    make_folder(directory / "sweeps")
    by_name = {job.name: job for job in jobs}
    tasks, after = _tasks(jobs)
    so_far = StudyProgress(len(jobs), sum(job.frames for job in jobs), blocks=len(tasks) - len(jobs))
    if progress:
        progress(so_far)
    for _, outcome in where.run(run_task, tasks, lost_task, after):
        if isinstance(outcome, BlockOutcome):
            so_far.add_block(outcome, where.workers)
        else:
            outcomes[outcome.name] = _require_here(outcome, by_name[outcome.name])
            so_far.add(outcome, by_name[outcome.name].frames, where.workers)
        if progress:
            progress(so_far)
    _clear(jobs)
    return _write_study(directory, [outcomes[each.name] for each in plan], settings)


def run_task(task: Task) -> TaskOutcome:
    """Do a sweep's or a block's job."""
    return run_block(task) if isinstance(task, BlockJob) else run_sweep(task)


def lost_task(task: Task, reason: str) -> TaskOutcome:
    """Outcome of a job that has none of its own."""
    return lost_block(task, reason) if isinstance(task, BlockJob) else lost(task, reason)


def _tasks(jobs: Sequence[SweepJob]) -> tuple[list[Task], dict[int, range]]:
    """All jobs, and which come after which: a long sweep's own after those of its blocks."""
    tasks: list[Task] = []
    after: dict[int, range] = {}
    for job in jobs:
        blocks = plan_blocks(job)
        after[len(tasks) + len(blocks)] = range(len(tasks), len(tasks) + len(blocks))
        tasks += [*blocks, job]
    return tasks, after


def _require_here(outcome: SweepOutcome, job: SweepJob) -> SweepOutcome:
    """Fail a sweep whose results a worker wrote to a disk that is not seen from here."""
    if outcome.status == "done" and finished(job) is None:
        return lost(job, f"{job.folder}: expected a folder that workers and the study share, got none here")
    return outcome


def _require_known(modes: tuple[str, ...] | None, reference: str | None) -> None:
    """Refuse what would be wrong for every sweep before any work is done."""
    for mode in modes or ():
        if mode not in KNOWN_MODES:
            raise InvalidInputError(f"expected a mode among {', '.join(KNOWN_MODES)}; got {mode!r}")
    if reference is not None and reference not in REFERENCES:
        raise InvalidInputError(f"expected a reference among {', '.join(REFERENCES)}; got {reference!r}")


def _named(paths: Sequence[Path]) -> list[tuple[str, Path]]:
    """Each path once, by its stem, or with its folder or a number where that is taken."""
    named: dict[str, Path] = {}
    for path in dict.fromkeys(each.resolve() for each in paths):
        names = [path.stem, f"{path.parent.name}-{path.stem}"]
        names += [f"{path.stem}-{number}" for number in range(2, len(paths) + 2)]
        named[next(name for name in names if name not in named)] = path
    return list(named.items())


def _clear(jobs: Sequence[SweepJob]) -> None:
    """Remove what killed workers left of this study's own sweeps."""
    for job in jobs:
        for part in job.folder.parent.glob(f".part-*-{job.folder.name}"):
            shutil.rmtree(part, ignore_errors=True)
        blocks = block_files(job).folder
        for part in blocks.glob(".part-*"):
            part.unlink(missing_ok=True)
        with suppress(OSError):
            blocks.parent.rmdir()


def _write_study(directory: Path, outcomes: Sequence[SweepOutcome], settings_toml: str) -> Study:
    summaries: list[Summary] = []
    drift: list[dict[str, Any]] = []
    for outcome in outcomes:
        if outcome.status == "done":
            folder = directory / outcome.folder
            summaries.append(_read_summary(folder, outcome.name))
            rows = json.loads((folder / "drift.json").read_text(encoding="utf-8"))
            drift += [{"sweep": outcome.name} | row for row in rows]
    rows = [{"sweep": each.sweep} | asdict(row) for each in summaries for row in each.rows]
    intervals, paired = over_sweeps(rows, drift)
    table = table_text(summaries) + "".join(
        f"{each.name}  failed: {each.reason}\n" for each in outcomes if each.status == "failed"
    )
    if overall := overall_text(intervals, paired):
        table += f"\n{overall}"
    contents = {
        "format": FORMAT,
        "version": VERSION,
        "settings_toml": settings_toml,
        "modes": list(dict.fromkeys(row["mode"] for row in rows)),
        "sweeps": [_entry(outcome) for outcome in outcomes],
        "rows": rows,
        "drift": drift,
        "intervals": intervals,
        "paired": paired,
    }
    texts = {
        "study.json": json.dumps(plain(contents), indent=2, allow_nan=False) + "\n",
        "table.txt": table,
        "table.csv": _csv(summaries, outcomes),
    }
    for name, text in texts.items():
        with atomic_path(directory / name) as part:
            part.write_text(text, encoding="utf-8")
    return Study(directory, outcomes, summaries, drift, table)


def _entry(outcome: SweepOutcome) -> dict[str, Any]:
    shown = asdict(outcome) | {"path": str(outcome.path)}
    return {name: value for name, value in shown.items() if name != "skipped"}


def _read_summary(folder: Path, name: str) -> Summary:
    """Read a sweep's rows back; a number that was not finite is NaN again."""
    held: dict[str, Any]
    (held,) = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["sweeps"]
    names = [f.name for f in fields(ModeError)]
    rows: list[dict[str, Any]] = [
        {name: float("nan") if row[name] is None else row[name] for name in names} for row in held["rows"]
    ]
    return Summary(
        name, held["reference"], held["frames"], held["coverage"], [ModeError(**row) for row in rows]
    )


def _csv(summaries: Sequence[Summary], outcomes: Sequence[SweepOutcome]) -> str:
    """All rows, and one for each sweep that failed, with the reason in a column of its own."""
    lines = list(csv.reader(io.StringIO(csv_text(summaries))))
    width = len(lines[0])
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*lines[0], "reason"])
    writer.writerows([*line, ""] for line in lines[1:])
    for each in outcomes:
        if each.status == "failed":
            writer.writerow([each.name, *[""] * (width - 1), each.reason])
    return text.getvalue()
