"""The study of Housden et al. 2008 [1]_ in simulation: eleven sweeps in every mode, beside their results.

Five sweeps of tissue one way, five with a change of direction, and a long one of a phantom, turned on the
way. As in the paper, orientation correction uses the tracker's orientation, and modes are compared with the
tracker; here the truth is known too. Biases come from the simulated physics: fibres, layers and poorly filled
tissue are coherent, noise and turning decorrelate; nothing is added to the poses.

References
----------
.. [1] R. J. Housden et al., "Calibration of an orientation sensor for freehand 3D ultrasound and its use in a
   hybrid acquisition system", BioMedical Engineering OnLine 7:5, 2008.
"""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.progress import Progress
from speckle3d.core.streams import TimedRotations
from speckle3d.core.sweep import OrientationSensor, Sweep
from speckle3d.core.text import text_table
from speckle3d.io.family.reconstructions import read_reconstruction
from speckle3d.io.family.sweep_writer import write_sweep
from speckle3d.io.hdf5 import make_folder
from speckle3d.io.load import load_sweep
from speckle3d.scoring.lengths import TRACKER, ModeError
from speckle3d.scoring.references import error_rows, find_reference, tracker_alone
from speckle3d.scoring.statistics import mean_interval
from speckle3d.simulation.presets import simulate
from speckle3d.simulation.settings import SimulationSettings
from speckle3d.study.compare import compare_sweeps
from speckle3d.study.overall import number, with_interval, words_of
from speckle3d.study.results import Study, SweepOutcome, json_text, write_texts
from speckle3d.study.schedulers import Scheduler

_TISSUE = SimulationSettings(preset="tissue", vectors=48, length_mm=20.0)
_REVERSAL = SimulationSettings(preset="reversal", vectors=48, length_mm=10.0)
_TURNING = SimulationSettings(preset="rotation", vectors=48, turn_deg=8.0)
SWEEPS: Mapping[str, SimulationSettings] = {
    **{f"beef-{k}": _TISSUE.model_copy(update={"seed": 3000 + k}) for k in range(1, 6)},
    **{f"beef-{k}": _REVERSAL.model_copy(update={"seed": 3000 + k}) for k in range(6, 11)},
    "phantom": _TURNING.model_copy(update={"seed": 3011, "length_mm": 30.0}),
}
"""By data set. The published sweeps of beef are 1.5 to 4 mm long; these are 10 and 20 mm, in which the
tracker's jitter of 0.15 mm is less than one per cent."""

QUANTITIES = ("length_error_percent", "tilt_error_deg")
MODES = ("image", "pose", "orientation")
"""In the order of the paper's tables 3 and 4: image-based, six DOF correction, orientation correction."""

Rows = Mapping[str, Mapping[str, Sequence[ModeError]]]
"""Errors by reference, then by data set."""

_Input = tuple[Path, SimulationSettings]
"""File of a sweep to be simulated, and its settings."""


def published_errors() -> dict[str, list[ModeError]]:
    """Tables 3 and 4: errors of length and tilt by data set, of every part (f forward, r back) and mode."""
    text = files("speckle3d.study").joinpath("housden2008.csv").read_text(encoding="utf-8")
    rows: dict[str, list[ModeError]] = {}
    for name, part, mode, percent, tilt_deg in list(csv.reader(text.splitlines()))[1:]:
        errors = {"length_error_percent": float(percent), "tilt_error_deg": float(tilt_deg)}
        rows.setdefault(name, []).append(ModeError(part, mode, 0, **errors))
    return rows


def paper_study(
    directory: Path,
    curves: Path,
    scheduler: Scheduler | None = None,
    progress: Progress | None = None,
    simulation_progress: Progress | None = None,
) -> tuple[Study, str]:
    """Simulate the eleven sweeps, compare the modes, and write it all into `directory`.

    Written, beside what `compare_sweeps` writes: ``inputs/``, kept for the next time, ``paper.txt`` and
    ``paper.json``.

    Parameters
    ----------
    curves : path
        Decorrelation curves of the simulated probe.
    simulation_progress : callable, optional
        Called with the number of sweeps simulated and their total.

    Returns
    -------
    study : Study
        As `compare_sweeps` left it.
    table : str
        Beside the paper's.

    Raises
    ------
    InvalidInputError
        If a sweep cannot be simulated.
    """
    runner, tell = scheduler or Scheduler(), simulation_progress or (lambda count, total: None)
    settings = "".join(sweep.model_dump_json() for sweep in SWEEPS.values())
    key = hashlib.sha256(f"{settings}{version('speckle3d')}".encode()).hexdigest()[:8]
    folder = directory / "inputs" / key
    make_folder(folder)
    paths = [folder / f"{name}.h5" for name in SWEEPS]
    missing = [job for job in zip(paths, SWEEPS.values(), strict=True) if not job[0].is_file()]
    present = len(paths) - len(missing)
    tell(present, len(paths))
    for count, _ in enumerate(runner.run(_write_input, missing, _raise), present + 1):
        tell(count, len(paths))
    study = compare_sweeps(paths, directory, None, TRACKER, curves, scheduler=runner, progress=progress)
    rows: Rows = {
        "published": published_errors(),
        TRACKER: {summary.sweep: summary.rows for summary in study.summaries},
        "truth": {o.name: _compare_with_truth(study.directory, o) for o in study.successes},
    }
    table = text_beside(rows)
    numbers = json_text({"means": beside(rows), "rows": rows})
    write_texts(directory, {"paper.txt": table, "paper.json": numbers})
    return study, table


def beside(rows: Rows) -> list[dict[str, Any]]:
    """Means of absolute errors over all parts, published and ours.

    Returns
    -------
    list of dict
        ``mode``, ``against`` ("published", or a reference of ours), ``quantity`` and its `mean_interval`.
        Parts, not sweeps, are the units, as there are 17 in the tables.
    """
    return [
        {"mode": mode, "against": name, "quantity": key, **mean_interval(np.abs(errors))}
        for key in QUANTITIES
        for mode in MODES
        for name, by_sweep in rows.items()
        if (errors := [getattr(row, key) for row in chain(*by_sweep.values()) if row.mode == mode])
    ]


def text_beside(rows: Rows) -> str:
    """Both tables, part by part, published | ours, and the means of absolute errors below.

    Of ours, the errors against the tracker are listed part by part.
    """
    lines = [["data set", *(f"{mode} {unit}" for unit in ("%", "°") for mode in MODES)]]
    for name, published in rows["published"].items():
        tables = [
            {(row.part, row.mode): row for row in errors}
            for errors in (published, rows[TRACKER].get(name, ()))
        ]
        for part in dict.fromkeys(row.part for row in published):
            cells = [
                " | ".join(
                    number(key, getattr(table.get((part, mode)), key, None), signed=True) for table in tables
                )
                for key in QUANTITIES
                for mode in MODES
            ]
            lines.append([f"{name} {part}", *cells])
    means = [["mean absolute error", "mode", "against", "mean [95 % of bootstrap samples]"]]
    means += [
        [words_of(row["quantity"]), row["mode"], row["against"], with_interval(row, "mean")]
        for row in beside(rows)
    ]
    return (
        "Errors of length (%) and tilt (°), published (Housden 2008, tables 3 and 4) | simulated, against "
        "the tracker.\nThe published sweeps of beef are 1.5 to 4 mm long, these 10 or 20 mm.\n\n"
        f"{text_table(lines)}\n{text_table(means, (0, 1, 2, 3))}"
    )


def _write_input(job: _Input) -> None:
    """Simulate one sweep into its file."""
    path, settings = job
    simulation = simulate(settings)[0]
    write_sweep(path, _with_trackers_orientation(simulation.sweep), simulation=simulation.description())


def _raise(job: _Input, reason: str) -> None:
    raise InvalidInputError(f"{job[0].name}: cannot be simulated: {reason}")


def _with_trackers_orientation(sweep: Sweep) -> Sweep:
    """The sweep with the tracker's orientation in place of the orientation sensor's, as in the paper."""
    tracker = sweep.tracker
    assert tracker is not None
    assert tracker.sensor_from_image is not None
    readings = TimedRotations(tracker.readings.time_s, tracker.readings.world_from_sensor.rotation)
    mounting = tracker.sensor_from_image.rotation
    return replace(sweep, orientation=OrientationSensor(readings, mounting, tracker.time_offset_s))


def _compare_with_truth(directory: Path, outcome: SweepOutcome) -> list[ModeError]:
    """Errors of the same poses, and of the tracker alone, against the truth."""
    sweep, path = load_sweep(outcome.path), directory / outcome.folder / "reconstruction.h5"
    tracker, poses = tracker_alone(sweep), read_reconstruction(path, with_pairs=False).poses
    estimates = poses if tracker is None else {**poses, TRACKER: tracker}
    return error_rows(estimates, find_reference(sweep, "truth"), sweep.grid.centre_mm)
