"""The eleven sweeps of Housden et al. 2008 in simulation: made, reconstructed in every mode, and compared.

Five sweeps of tissue one way, five with a change of direction, and a long one of a phantom, turned on the
way. As in the paper, orientation correction uses the tracker's orientation, and the tracker is what modes are
compared with; unlike there, the truth is known too. Biases come from the simulated physics: fibres, layers
and poorly filled tissue are coherent, noise and turning decorrelate; nothing is added to the poses.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.streams import TimedRotations
from speckle3d.core.sweep import OrientationSensor, Sweep
from speckle3d.io.curves import write_curves
from speckle3d.io.hdf5 import atomic_path, make_folder, one_line
from speckle3d.io.load import load_sweep
from speckle3d.io.reconstructions import read_reconstruction
from speckle3d.io.sweep_writer import write_sweep
from speckle3d.pipeline import calibrate_curves
from speckle3d.scoring.lengths import ModeError, compare_modes
from speckle3d.simulation.presets import SimulationSettings, simulate
from speckle3d.study.compare import StudyProgress, compare_sweeps
from speckle3d.study.lock import only_run
from speckle3d.study.published import json_beside, text_beside
from speckle3d.study.results import Study
from speckle3d.study.schedulers import InProcess, Scheduler

_TISSUE = SimulationSettings(preset="tissue", vectors=48, length_mm=20.0)
_REVERSAL = SimulationSettings(preset="reversal", vectors=48, length_mm=10.0)
_PHANTOM = SimulationSettings(
    preset="rotation", vectors=48, length_mm=30.0, turn_deg=8.0, reverse=True, seed=3011
)
SWEEPS: Mapping[str, SimulationSettings] = {
    **{f"beef-{k}": _TISSUE.model_copy(update={"seed": 3000 + k}) for k in range(1, 6)},
    **{f"beef-{k}": _REVERSAL.model_copy(update={"seed": 3000 + k}) for k in range(6, 11)},
    "phantom": _PHANTOM,
}
"""By data set. The published sweeps of beef are 1.5 to 4 mm long; these are 10 and 20 mm, in which the
tracker's jitter of 0.15 mm is less than one per cent."""

_STEPPED = SimulationSettings(preset="stepped", vectors=48, steps=27, step_mm=0.06, blocks=6)
_TURNING = SimulationSettings(preset="rotation", vectors=48, turn_deg=8.0)
CURVE_SWEEPS: Mapping[str, SimulationSettings] = {
    **{f"stepped-{k}": _STEPPED.model_copy(update={"seed": k}) for k in (11, 12, 13)},
    **{f"turning-{k}": _TURNING.model_copy(update={"seed": k}) for k in (14, 15)},
    "turning-16": _TURNING.model_copy(update={"seed": 16, "turn_deg": 20.0, "length_mm": 2.0, "frames": 160}),
}
"""Phantom sweeps, of other seeds, from which decorrelation curves are measured if none are given."""


@dataclass(frozen=True)
class PaperStudy:
    """The study as `compare_sweeps` left it, and the table beside the paper's."""

    study: Study
    table: str


@dataclass(frozen=True)
class _Input:
    """A sweep to be simulated into a file; it travels to workers."""

    path: Path
    settings: SimulationSettings
    as_published: bool


def paper_study(
    directory: Path,
    curves: Path | None = None,
    scheduler: Scheduler | None = None,
    progress: Callable[[StudyProgress], None] | None = None,
    simulated: Callable[[int, int], None] | None = None,
) -> PaperStudy:
    """Simulate the eleven sweeps, compare the modes, and write it all into `directory`.

    Written, beside what `compare_sweeps` writes: ``inputs/``, kept for the next time, ``paper.txt`` and
    ``paper.json``.

    Parameters
    ----------
    curves : path, optional
        Decorrelation curves of the simulated probe; by default they are measured, which takes as long again.
    simulated : callable, optional
        Called with the number of sweeps simulated and their total.

    Raises
    ------
    InvalidInputError
        If a sweep cannot be simulated.
    """
    where = scheduler or InProcess()
    with only_run(directory):
        return _study(directory, curves, where, progress, simulated)


def _study(
    directory: Path,
    curves: Path | None,
    where: Scheduler,
    progress: Callable[[StudyProgress], None] | None,
    simulated: Callable[[int, int], None] | None,
) -> PaperStudy:
    wanted = SWEEPS if curves is not None else {**SWEEPS, **CURVE_SWEEPS}
    inputs = _inputs(directory, wanted)
    _simulate(inputs, where, simulated)
    if curves is None:
        curves = _measured([inputs[name].path for name in CURVE_SWEEPS])
    paths = [inputs[name].path for name in SWEEPS]
    study = compare_sweeps(
        paths, directory, reference="tracker", curves=curves, scheduler=where, progress=progress
    )
    rows: dict[str, Mapping[str, Sequence[ModeError]]] = {
        "tracker": {each.sweep: each.rows for each in study.summaries},
        "truth": _against_truth(study, directory),
    }
    table = text_beside(rows)
    for name, text in (("paper.txt", table), ("paper.json", json_beside(rows))):
        with atomic_path(directory / name) as part:
            part.write_text(text, encoding="utf-8")
    return PaperStudy(study, table)


def _inputs(directory: Path, wanted: Mapping[str, SimulationSettings]) -> dict[str, _Input]:
    """Where each sweep goes: a folder whose name says what it was made by."""
    settings = "".join(each.model_dump_json() for each in {**SWEEPS, **CURVE_SWEEPS}.values())
    key = hashlib.sha256(f"{settings}{version('speckle3d')}".encode()).hexdigest()[:8]
    folder = directory / "inputs" / key
    make_folder(folder)
    return {name: _Input(folder / f"{name}.h5", each, name in SWEEPS) for name, each in wanted.items()}


def _simulate(
    inputs: Mapping[str, _Input], where: Scheduler, progress: Callable[[int, int], None] | None
) -> None:
    missing = [each for each in inputs.values() if not each.path.is_file()]
    done = len(inputs) - len(missing)
    if progress is not None:
        progress(done, len(inputs))
    for _, failure in where.run(_write_input, missing, _failed):
        if failure:
            raise InvalidInputError(failure)
        done += 1
        if progress is not None:
            progress(done, len(inputs))


def _write_input(job: _Input) -> str:
    """Simulate one sweep into its file; returned is what went wrong, if anything did."""
    try:
        made = simulate(job.settings)[0]
        sweep = _with_tracked_orientation(made.sweep) if job.as_published else made.sweep
        write_sweep(job.path, sweep, simulation=made.description())
    except Exception as error:  # noqa: BLE001 - it travels back from a worker as a line
        return _failed(job, one_line(error))
    return ""


def _failed(job: _Input, reason: str) -> str:
    return f"{job.path.name}: cannot be simulated: {reason}"


def _with_tracked_orientation(sweep: Sweep) -> Sweep:
    """The sweep with the tracker's orientation in place of the orientation sensor's, as in the paper."""
    tracker = sweep.tracker
    assert tracker is not None
    assert tracker.sensor_from_image is not None
    readings = TimedRotations(tracker.readings.time_s, tracker.readings.world_from_sensor.rotation)
    mounting = tracker.sensor_from_image.rotation
    return replace(sweep, orientation=OrientationSensor(readings, mounting, tracker.time_offset_s))


def _measured(phantoms: Sequence[Path]) -> Path:
    path = phantoms[0].parent / "curves.h5"
    if not path.is_file():
        write_curves(path, calibrate_curves([load_sweep(each) for each in phantoms]))
    return path


def _against_truth(study: Study, directory: Path) -> dict[str, list[ModeError]]:
    """Errors of the same poses against the truth, by data set."""
    found = {}
    for outcome in study.outcomes:
        if outcome.status == "done":
            sweep = load_sweep(outcome.path)
            poses = read_reconstruction(
                directory / outcome.folder / "reconstruction.h5", with_pairs=False
            ).poses
            assert sweep.truth is not None
            found[outcome.name] = compare_modes(poses, sweep.truth, sweep.grid.centre_mm, end_frames=1)
    return found
