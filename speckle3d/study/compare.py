"""Compare modes over many sweeps, and write a study's folder: what ``speckle3d compare`` does.

Every sweep is one job with a folder of its own, which appears whole or not at all under a name that holds a
hash of everything that determines its content. A study started again finds the folders that are there and
does what is missing.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

from speckle3d.calibration_files import apply_calibrations
from speckle3d.config import Config, config_from_toml
from speckle3d.core.errors import Speckle3DError
from speckle3d.core.progress import Progress
from speckle3d.core.text import printable
from speckle3d.io.family.curves import read_curves
from speckle3d.io.hdf5 import make_folder, one_line, sha256_of
from speckle3d.io.load import load_sweep, recording_sha256
from speckle3d.study.job import RESULTS, available_modes, run_job
from speckle3d.study.results import FILES, Study, SweepOutcome, read_summary, require_own, write_study
from speckle3d.study.schedulers import Scheduler
from speckle3d.tracking import curves_beside


@dataclass(frozen=True)
class StudyRequest:
    """Request of a study: modes, settings and reference of each sweep.

    Attributes
    ----------
    curves : path, optional
        By default curves.h5 beside each sweep.
    modes : tuple of str, or None
        Beside `image`; None for all that a sweep has sensors for.
    """

    directory: Path
    curves: Path | None
    settings_toml: str
    modes: tuple[str, ...] | None
    reference: str | None
    calibrations: tuple[Path, ...]

    def plan(self, name: str, path: Path) -> SweepOutcome:
        """Plan a sweep: its folder is named after all that determines its content; failed if it cannot be."""
        crossing = self._crossing(path)
        try:
            frames, sha256 = len(load_sweep(path)), recording_sha256(path)
            hashes = [sha256_of(file) for file in (self._curves(path), *self.calibrations)]
            hashes += [] if crossing is None else [recording_sha256(crossing)]
        except Exception as error:  # noqa: BLE001 - one row that says why
            return SweepOutcome(name, path, _reason(error))
        parts = [sha256, self.settings_toml, version("speckle3d"), self.modes, self.reference, hashes]
        key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()
        return SweepOutcome(name, path, "", sha256, key, f"sweeps/{name}-{key[:8]}", frames)

    def run(self, plan: SweepOutcome) -> SweepOutcome:
        """Reconstruct a sweep unless its folder is there; an error becomes the outcome's reason."""
        folder = self.directory / plan.folder
        is_old = (folder / RESULTS.primary).is_file()
        try:
            if not is_old:
                self._reconstruct(plan.path, folder)
            return replace(plan, is_old=is_old, summary=read_summary(folder, plan.name))
        except Exception as error:  # noqa: BLE001 - one broken sweep, or one bug that it reveals, stops no other
            return failure(plan, _reason(error))

    def _reconstruct(self, path: Path, folder: Path) -> None:
        settings, crossing = config_from_toml(self.settings_toml), self._crossing(path)
        sweep = load_sweep(path)
        modes: Sequence[str] | None = self.modes
        if modes is None:
            modes = available_modes(apply_calibrations(sweep, self.calibrations)[0], settings)
        run_job(
            sweep,
            path,
            read_curves(self._curves(path)),
            folder,
            [mode for mode in modes if mode != "image"],
            self.reference,
            settings,
            calibrations=self.calibrations,
            crossing=None if crossing is None else (load_sweep(crossing), crossing),
        )

    def _curves(self, path: Path) -> Path:
        return self.curves or curves_beside(path)

    def _crossing(self, path: Path) -> Path | None:
        """``SWEEP-crossing.h5`` of ``SWEEP.h5``, and the other way round, if mode `crossed` is asked for."""
        stem = path.stem.removesuffix("-crossing")
        name = stem if stem != path.stem else f"{stem}-crossing"
        return path.with_name(f"{name}{path.suffix}") if "crossed" in (self.modes or ()) else None


def failure(plan: SweepOutcome, reason: str) -> SweepOutcome:
    """Outcome of a sweep that failed."""
    return replace(plan, reason=reason, folder="")


def compare_sweeps(
    paths: Sequence[Path],
    directory: Path,
    modes: Sequence[str] | None = None,
    reference: str | None = None,
    curves: Path | None = None,
    config: Config | None = None,
    calibrations: Sequence[Path] = (),
    scheduler: Scheduler | None = None,
    progress: Progress | None = None,
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
        Called at the beginning and after each sweep with the number of frames done and of all.

    Raises
    ------
    InvalidInputError
        If the folder holds something else.
    FileError
        If the folder cannot be written.
    """
    require_own(directory, FILES)
    if curves is not None:
        read_curves(curves)
    request = StudyRequest(
        directory.resolve(),
        curves and curves.resolve(),
        (config or Config()).to_toml(),
        None if modes is None else tuple(dict.fromkeys(modes)),
        reference,
        tuple(path.resolve() for path in calibrations),
    )
    outcomes: dict[str, SweepOutcome] = {}
    first_names: dict[str, str] = {}
    for name, path in name_files(paths):
        plan = request.plan(name, path.resolve())
        if plan.sha256 and (twin := first_names.setdefault(plan.sha256, name)) != name:
            plan = failure(plan, f"the same recording as {twin}, which counts once")
        outcomes[name] = plan
    # The longest first, so that no worker is left with it while the others have nothing to do.
    todo = sorted((plan for plan in outcomes.values() if plan.folder), key=lambda plan: -plan.frames)
    make_folder(directory / "sweeps")
    frames, total, tell = 0, sum(plan.frames for plan in todo), progress or (lambda frames, total: None)
    tell(frames, total)
    for outcome in (scheduler or Scheduler()).run(request.run, todo, failure):
        outcomes[outcome.name] = outcome
        frames += outcome.frames
        tell(frames, total)
    study = Study(directory, list(outcomes.values()), request.settings_toml)
    write_study(study)
    return study


def name_files(paths: Sequence[Path]) -> list[tuple[str, Path]]:
    """Name each file once, by its stem, and by a hash of its path, too, if others have the same stem.

    Names depend on the files alone, not on their order: a study given again in another order is the same.
    """
    files = list({path.resolve(): path.absolute() for path in paths}.values())
    # What a terminal would obey is escaped, with % in place of the backslash.
    stems = [printable(path.stem).replace("\\", "%") for path in files]
    marks = [hashlib.sha256(os.fsencode(path)).hexdigest()[:6] for path in files]
    counts = Counter(stems)
    names = [stem if counts[stem] == 1 else f"{stem}-{mark}" for stem, mark in zip(stems, marks, strict=True)]
    return list(zip(names, files, strict=True))


def _reason(error: Exception) -> str:
    words = " ".join(one_line(error).split())
    return words if isinstance(error, Speckle3DError) else f"{type(error).__name__}: {words}"
