"""Compare modes over many sweeps, and write a study's folder: what ``speckle3d compare`` does.

Every sweep is one job with a folder of its own, which appears whole or not at all under a name that holds a
hash of everything that determines its content. A study started again finds the folders that are there and
does what is missing.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path

from speckle3d.config import Config, config_from_toml
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, Speckle3DError
from speckle3d.core.printable import printable
from speckle3d.correction.modes import DRIFT_MODES
from speckle3d.io.calibrations import apply_calibrations
from speckle3d.io.curves import read_curves
from speckle3d.io.hdf5 import make_folder, one_line, sha256_of
from speckle3d.io.load import load_sweep, recording_sha256
from speckle3d.scoring.references import require_reference
from speckle3d.study.job import RESULTS, run_job
from speckle3d.study.request import SUBSET, available_modes
from speckle3d.study.results import FILES, Study, SweepOutcome, is_study, require_own, write_study
from speckle3d.study.schedulers import Scheduler

KNOWN_MODES = ("image", SUBSET, *DRIFT_MODES)


@dataclass(frozen=True)
class SweepJob:
    """One sweep to reconstruct, with everything that determines the result.

    Attributes
    ----------
    planned : SweepOutcome
        With the name, the input and the key: SHA-256 of the input's bytes, configuration, version, modes,
        reference, curves and calibrations.
    modes : tuple of str, or None
        Beside `image`; None for all that the sweep has sensors for.
    crossing : path, optional
        The crossing sweep, if mode `crossed` is asked for.
    """

    planned: SweepOutcome
    folder: Path
    curves: Path
    settings_toml: str
    modes: tuple[str, ...] | None
    reference: str | None
    calibrations: tuple[Path, ...]
    crossing: Path | None = None

    def failed(self, reason: str) -> SweepOutcome:
        """What became of it if it failed."""
        return replace(self.planned, status="failed", reason=reason)

    def done(self, skipped: bool = False) -> SweepOutcome:
        """What became of it if its folder is there, which is whole then."""
        (summary,) = json.loads((self.folder / "summary.json").read_text(encoding="utf-8"))["sweeps"]
        seconds, folder = float(summary["details"]["seconds"]), f"sweeps/{self.folder.name}"
        return replace(self.planned, status="done", folder=folder, seconds=seconds, skipped=skipped)


@dataclass
class StudyProgress:
    """How far a study is, and how long the rest will take by the pace so far; skipped sweeps set no pace."""

    sweeps: int
    frames: int
    done: int = 0
    failed: int = 0
    done_frames: int = 0
    remaining_s: float | None = None
    _run_frames: int = 0
    _began_s: float = field(default_factory=time.monotonic)

    def add(self, outcome: SweepOutcome) -> None:
        """Count a finished sweep."""
        self.done += 1
        self.failed += outcome.status == "failed"
        self.done_frames += outcome.frames
        self._run_frames += outcome.frames * (outcome.status == "done" and not outcome.skipped)
        if self._run_frames:
            pace_s = (time.monotonic() - self._began_s) / self._run_frames
            self.remaining_s = pace_s * (self.frames - self.done_frames)


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
        Beside `image`; by default all that each sweep has sensors for. "crossed" takes for the crossing
        sweep of ``SWEEP.h5`` the file ``SWEEP-crossing.h5`` beside it.
    curves : path, optional
        Decorrelation curves; by default curves.h5 beside each sweep.
    progress : callable, optional
        Called at the beginning and after each sweep.

    Raises
    ------
    InvalidInputError, InsufficientDataError
        If a setting is wrong for all sweeps, or none can be compared.
    FileError
        If the folder cannot be written.
    """
    if not paths:
        raise InvalidInputError("expected at least one sweep, got none")
    chosen = None if modes is None else tuple(dict.fromkeys(modes))
    # What is wrong for one sweep is wrong for all: refused before any work is done.
    for mode in chosen or ():
        if mode not in KNOWN_MODES:
            raise InvalidInputError(f"expected a mode among {', '.join(KNOWN_MODES)}; got {mode!r}")
    require_reference(reference)
    require_own(directory, FILES, is_study(directory), "a study to go on with or to replace")
    if curves is not None:
        read_curves(curves)
    settings = (config or Config()).to_toml()
    jobs: list[SweepJob] = []
    outcomes: dict[str, SweepOutcome] = {}
    first: dict[str, str] = {}
    for name, path in named(paths):
        plan = plan_sweep(name, path, directory, curves, settings, chosen, reference, tuple(calibrations))
        if isinstance(plan, SweepJob) and (same := first.setdefault(plan.planned.sha256, name)) != name:
            plan = plan.failed(f"the same recording as {same}, which counts once")
        if isinstance(plan, SweepJob):
            jobs.append(plan)
        outcomes[name] = plan.planned if isinstance(plan, SweepJob) else plan
    if not jobs:
        one = next(iter(outcomes.values()))
        raise InsufficientDataError(
            f"expected a sweep that can be compared, got none of {len(outcomes)}; {one.name}: {one.reason}"
        )
    # The longest first, so that no worker is left with it while the others have nothing to do.
    jobs.sort(key=lambda job: -job.planned.frames)
    make_folder(directory / "sweeps")
    so_far = StudyProgress(len(jobs), sum(job.planned.frames for job in jobs))
    tell = progress or (lambda at: None)
    tell(so_far)
    try:
        for outcome in (scheduler or Scheduler()).run(run_sweep, jobs, SweepJob.failed):
            outcomes[outcome.name] = outcome
            so_far.add(outcome)
            tell(so_far)
    finally:
        for folder in (directory / "sweeps", directory):
            with suppress(OSError):  # it holds finished sweeps
                folder.rmdir()
    return write_study(directory, list(outcomes.values()), settings)


def named(paths: Sequence[Path]) -> list[tuple[str, Path]]:
    """Name each file once, by its stem; files of one stem with their folder, too, and a hash if need be.

    Names depend on the files alone, not on their order: a study given again in another order is the same.
    """
    files = list({path.resolve(): path.absolute() for path in paths}.values())
    # What a terminal would obey is escaped, with % in place of the backslash.
    names = [printable(path.stem).replace("\\", "%") for path in files]
    folders = [printable(path.parent.name).replace("\\", "%") for path in files]
    marks = [hashlib.sha256(os.fsencode(path)).hexdigest()[:6] for path in files]
    for more in (folders, marks):
        counts = Counter(names)
        names = [
            name if counts[name] == 1 else f"{word}-{name}" for word, name in zip(more, names, strict=True)
        ]
    return list(zip(names, files, strict=True))


def plan_sweep(
    name: str,
    path: Path,
    directory: Path,
    curves: Path | None,
    settings_toml: str,
    modes: tuple[str, ...] | None,
    reference: str | None,
    calibrations: tuple[Path, ...],
) -> SweepJob | SweepOutcome:
    """Find out what determines a sweep's results; an outcome at once if it cannot be opened."""
    path = path.resolve()
    curves_file = (curves or path.parent / "curves.h5").resolve()
    mounted = tuple(each.resolve() for each in calibrations)
    crossing = crossing_of(path) if "crossed" in (modes or ()) else None
    try:
        if crossing is not None and not crossing.exists():
            raise InvalidInputError(f"mode crossed: expected a crossing sweep {crossing.name} beside it")
        frames, sha256 = len(load_sweep(path)), recording_sha256(path)
        used = [sha256_of(each) for each in (curves_file, *mounted)]
        used += [] if crossing is None else [recording_sha256(crossing)]
    except Exception as error:  # noqa: BLE001 - one row that says why
        return SweepOutcome(name, path, "failed", _reason(error))
    parts = [sha256, settings_toml, version("speckle3d"), modes, reference, used]
    key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()
    folder = (directory / "sweeps" / f"{name}-{key[:8]}").resolve()
    planned = SweepOutcome(name, path, "planned", sha256=sha256, key=key, frames=frames)
    return SweepJob(planned, folder, curves_file, settings_toml, modes, reference, mounted, crossing)


def crossing_of(path: Path) -> Path:
    """The crossing sweep of ``SWEEP.h5``: ``SWEEP-crossing.h5`` beside it, and the other way round."""
    stem = path.stem.removesuffix("-crossing")
    return path.with_name(f"{stem}{path.suffix}" if stem != path.stem else f"{stem}-crossing{path.suffix}")


def run_sweep(job: SweepJob) -> SweepOutcome:
    """Do a job unless it is done; whatever is wrong with the sweep becomes the outcome's reason."""
    if (job.folder / RESULTS.primary).is_file():
        return job.done(skipped=True)
    path = job.planned.path
    try:
        if recording_sha256(path) != job.planned.sha256:
            raise InvalidInputError(f"{path}: expected the file that the study began with, got another")
        settings, sweep = config_from_toml(job.settings_toml), load_sweep(path)
        mounted, _ = apply_calibrations(sweep, job.calibrations)
        modes = available_modes(mounted, settings) if job.modes is None else job.modes
        run_job(
            sweep,
            path,
            read_curves(job.curves),
            job.folder,
            [mode for mode in modes if mode != "image"],
            job.reference,
            settings,
            calibrations=job.calibrations,
            crossing=None if job.crossing is None else (load_sweep(job.crossing), job.crossing),
        )
        return job.done()
    except Exception as error:  # noqa: BLE001 - one broken sweep, or one bug that it reveals, stops no other
        return job.failed(_reason(error))


def _reason(error: Exception) -> str:
    words = " ".join(one_line(error).split())
    return words if isinstance(error, Speckle3DError) else f"{type(error).__name__}: {words}"
