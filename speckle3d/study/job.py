"""Reconstruct one sweep into a folder of results: what ``speckle3d reconstruct`` does."""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from scipy.spatial.transform import RigidTransform

from speckle3d.config import Config
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import FileError, InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.printable import written_path
from speckle3d.core.reconstruction import Provenance, Trust
from speckle3d.core.sweep import Sweep
from speckle3d.correction.drift import DriftCorrection
from speckle3d.correction.modes import require_modes, sensor_of
from speckle3d.correction.trust import believed, cleaned_readings, name_of, require_believed
from speckle3d.io.calibrations import apply_calibrations
from speckle3d.io.fileset import FileSet
from speckle3d.io.hdf5 import PathLike, sha256_of
from speckle3d.io.load import kind_of
from speckle3d.io.reconstructions import FORMAT as RECONSTRUCTION
from speckle3d.io.reconstructions import ReconstructionWriter
from speckle3d.matching.quality import describe
from speckle3d.motion.direction import sensed_orientation
from speckle3d.pipeline import Progress, Tracked, correct, track
from speckle3d.scoring.lengths import END_FRAMES, ModeError, compare_modes
from speckle3d.scoring.references import Reference, SweepCurves, find_reference, sweep_curves
from speckle3d.study.figures import figure_drift, figure_reslice, save_figure
from speckle3d.study.folder import BlockFiles
from speckle3d.study.images import Strip, cut_frames, middle_plane
from speckle3d.study.results import Summary, is_study, summary_text, write_summary

SUBSET = "image+subset"
"""Mode of the images alone with the patches that contradict the sensed orientation left out."""


@dataclass(frozen=True)
class JobResult:
    """What a job found, and where it is.

    Attributes
    ----------
    directory : path
        The folder of results.
    summary : Summary
        Errors by part and mode, and details of the reconstruction.
    table : str
        The same errors as text.
    files : tuple of path
        What was written.
    seconds : float
        It took.
    """

    directory: Path
    summary: Summary
    table: str
    files: tuple[Path, ...]
    seconds: float


RESULTS = FileSet("reconstruction.h5", ("summary.json", "table.txt", "table.csv", "drift.png", "reslice.png"))
"""What a job writes."""


def run_job(
    sweep: Sweep,
    source: Path,
    curves: DecorrelationCurves,
    directory: Path,
    drift: Sequence[str] = (),
    reference: str | None = None,
    config: Config | None = None,
    progress: Progress | None = None,
    calibrations: Sequence[PathLike] = (),
    blocks: BlockFiles | None = None,
) -> JobResult:
    """Reconstruct a sweep and put everything that belongs to it into `directory`.

    Written: ``reconstruction.h5``, ``summary.json``, ``table.txt``, ``table.csv``, ``drift.png`` and
    ``reslice.png``. A new folder appears whole; in one that is there, all six take the place of earlier
    results together, and other files stay.

    Parameters
    ----------
    sweep : Sweep
    source : path
        The sweep's file, whose SHA-256 goes into the results.
    curves : DecorrelationCurves
    directory : path
        Made if need be.
    drift : sequence of str
        Modes beside `image`: "image+subset", "orientation", "pose".
    reference : {"tracker", "truth"}, optional
        What to compare with; by default the truth if stored, else the tracker, else nothing.
    config : Config, optional
    progress : callable, optional
        Called with the number of frames done and of all.
    calibrations : sequence of path
        Calibration files, at most one for each sensor, in place of what the sweep says of its sensors.
    blocks : BlockFiles, optional
        Blocks of the sweep that have been matched already.

    Returns
    -------
    JobResult

    Raises
    ------
    InvalidInputError, InsufficientDataError
        If the sweep lacks what a mode or the reference needs, or the folder holds other files of these
        names. A mode whose sensor the images or its own readings refute is left out of the results
        instead; `Summary.left_out` says why.
    FileError
        If the folder cannot be written, or another run is at work in it.
    """
    require_own_results(directory)
    with RESULTS.replaced(directory) as part:
        made = write_results(
            sweep, source, curves, part, drift, reference, config, progress, calibrations, blocks
        )
    return replace(made, directory=directory, files=tuple(directory / each.name for each in made.files))


def write_results(
    sweep: Sweep,
    source: Path,
    curves: DecorrelationCurves,
    directory: Path,
    drift: Sequence[str] = (),
    reference: str | None = None,
    config: Config | None = None,
    progress: Progress | None = None,
    calibrations: Sequence[PathLike] = (),
    blocks: BlockFiles | None = None,
) -> JobResult:
    """Reconstruct a sweep into a folder that is there and that nobody reads yet; otherwise as `run_job`."""
    settings = config or Config()
    began = time.perf_counter()
    sweep, mounted = apply_calibrations(sweep, calibrations)
    compared = require_possible(sweep, drift, reference, settings)
    fitted = [mode for mode in drift if mode != SUBSET]
    strip = Strip(sweep, settings)
    path = directory / RESULTS.primary
    with ReconstructionWriter(path, sweep.frame_time_s, sweep.grid) as writer:
        held = None if blocks is None else partial(blocks.read, strip=strip)
        tracked = track(sweep, curves, settings, progress, writer.append_pairs, strip.keep, held)
        corrections, left_out = _corrected(tracked, sweep, fitted, settings)
        poses = {"image": tracked.image}
        if tracked.subset is not None and SUBSET in drift:
            poses[SUBSET] = tracked.subset
        elif SUBSET in drift:
            left_out[SUBSET] = _refusal_of_subset(sweep, tracked)
        poses |= {mode: c.poses for mode, c in corrections.items()}
        provenance = Provenance(written_path(source), sha256_of(source), version("speckle3d"), mounted)
        writer.finish(poses, provenance, settings.to_toml(), Trust(tracked.covariance, tracked.flags))
    if reference is None and compared is not None and compared.name == "tracker":
        compared = compared if believed(sweep, tracked.doubts).tracker is not None else None
    moved = sweep_curves(poses, sweep.grid.centre_mm, compared, tracked.covariance)
    name, share = ("none", 0.0) if compared is None else (compared.name, float(compared.covered.mean()))
    rows = _errors(sweep, poses, moved, compared)
    details = _details(tracked, corrections, moved, provenance)
    doubted = _doubted(sweep, poses, tracked)
    summary = Summary(sweep.name, name, len(sweep), share, rows, details, tracked.doubts, doubted, left_out)
    files = [path, *write_summary(directory, summary)]
    files += [save_figure(figure_drift(moved, _title(summary)), directory / "drift.png")]
    files += [_draw_reslices(directory / "reslice.png", sweep.name, poses, compared, strip)]
    table, seconds = summary_text(summary), time.perf_counter() - began
    return JobResult(directory, summary, table, tuple(files), seconds)


def require_possible(
    sweep: Sweep, drift: Sequence[str], reference: str | None, config: Config
) -> Reference | None:
    """Check that a sweep has what is asked of it, before any work is done; returns the reference.

    Raises
    ------
    InvalidInputError, InsufficientDataError
        If it does not have it, naming the mode or the reference.
    """
    require_modes(sweep, [mode for mode in drift if mode != SUBSET])
    if SUBSET in drift and sensed_orientation(sweep, config.sensors) is None:
        raise InsufficientDataError(
            f"{sweep.name}: mode {SUBSET}: expected sensed orientation over every frame and the setting "
            "sensors.consistent_subset, got none"
        )
    return find_reference(cleaned_readings(sweep)[0] if config.sensors.examine else sweep, reference)


def require_own_results(directory: Path) -> None:
    """Refuse a folder in which a job's names stand for something else.

    Raises
    ------
    InvalidInputError
        Naming the first such file.
    """
    primary = directory / RESULTS.primary
    held = [name for name in RESULTS.names if (directory / name).exists()]
    if not held or (primary.is_file() and not is_study(directory) and _is_reconstruction(primary)):
        return
    raise InvalidInputError(
        f"{directory / held[0]}: expected a new folder or the results of `reconstruct` to replace, "
        "got a file of another origin"
    )


def _is_reconstruction(path: Path) -> bool:
    try:
        return kind_of(path) == RECONSTRUCTION
    except (FileError, InvalidInputError):
        return False


def available_modes(sweep: Sweep, config: Config) -> list[str]:
    """Modes beside `image` for which the sweep has sensors, calibrated to the image."""
    found = []
    for mode in (SUBSET, "orientation", "pose"):
        with suppress(InsufficientDataError):
            require_possible(sweep, [mode], None, config)
            found.append(mode)
    return found


def _corrected(
    tracked: Tracked, sweep: Sweep, modes: Sequence[str], config: Config
) -> tuple[dict[str, DriftCorrection], dict[str, str]]:
    """Corrections by mode, and why modes whose sensors are refuted are left out."""
    corrections: dict[str, DriftCorrection] = {}
    left_out: dict[str, str] = {}
    for mode in modes:
        try:
            corrections |= correct(tracked, sweep, [mode], config)
        except MismatchError as error:
            left_out[mode] = str(error)
    return corrections, left_out


def _refusal_of_subset(sweep: Sweep, tracked: Tracked) -> str:
    """Why there are no poses from the consistent subset, though there is a sensor for them."""
    try:
        require_believed(tracked.doubts, sweep.orientation_source, f"{sweep.name}: mode {SUBSET}")
    except MismatchError as error:
        return str(error)
    return (
        f"{sweep.name}: mode {SUBSET}: expected readings over every frame, got gaps where some are left out"
    )


def _doubted(sweep: Sweep, modes: Collection[str], tracked: Tracked) -> dict[str, str]:
    """What is suspected of the sensor that each mode rests on; images are under all of them."""
    found = {}
    for mode in modes:
        sensor = None if mode == "image" else sensor_of(sweep, mode)
        about = {"images", "curves", "" if sensor is None else name_of(sensor)}
        suspected = dict.fromkeys(doubt.suspect for doubt in tracked.doubts if doubt.about in about)
        if suspected:
            found[mode] = ", ".join(suspected)
    return found


def _title(summary: Summary) -> str:
    """Name of the sweep, and below it the modes in doubt, for figures."""
    doubted = [f"{mode} in doubt: {why}" for mode, why in summary.doubted.items()]
    left_out = [f"{mode} left out" for mode in summary.left_out]
    return "\n".join([summary.sweep, "; ".join(doubted + left_out)]).strip()


def _errors(
    sweep: Sweep, poses: dict[str, RigidTransform], moved: SweepCurves, reference: Reference | None
) -> list[ModeError]:
    if reference is None:
        return [ModeError.of_estimate(m, len(sweep), float(c[0, -1])) for m, c in moved.modes.items()]
    true, ends = reference.world_from_image, 1 if reference.name == "truth" else END_FRAMES
    return compare_modes(poses, true, sweep.grid.centre_mm, reference.covered, ends)


def _details(
    tracked: Tracked, corrections: dict[str, DriftCorrection], moved: SweepCurves, provenance: Provenance
) -> dict[str, Any]:
    names = ("length_mm", "tilt_deg", "yaw_deg", "roll_deg")
    return {
        "provenance": provenance,
        "estimates": {m: dict(zip(names, c[:, -1].tolist(), strict=True)) for m, c in moved.modes.items()},
        "pairs": tracked.pairs,
        "flagged_frames": describe(tracked.flags),
        "rejected_patch_share": tracked.rejected_share,
        "direction": tracked.direction,
        "direction_from": tracked.direction_from,
        "coherence": _coherence_details(tracked),
        "seconds_by_stage": tracked.times.seconds,
        "corrections": {mode: _fit_details(c) for mode, c in corrections.items()},
    }


def _coherence_details(tracked: Tracked) -> dict[str, Any] | None:
    found = tracked.coherence
    if found is None:
        return None
    return {
        "mean_share": float(found.share.mean()),
        "mean_gain": float(found.gain.mean()),
        "mean_stretch": float(found.stretch.mean()),
        "length_over_phantom_reading": float(found.scale.mean()),
        "scale_sigma": found.scale_sigma,
    }


def _fit_details(correction: DriftCorrection) -> dict[str, Any]:
    fit = correction.fit
    return {
        "curves": correction.settings.curves,
        "coverage": correction.coverage,
        "rms": fit.rms,
        "condition_number": fit.condition_number,
        "evaluations": fit.evaluations,
        "converged": fit.converged,
        "parameters": dict(zip(fit.names, fit.parameters.tolist(), strict=True)),
        "standard_errors": dict(zip(fit.names, fit.standard_errors.tolist(), strict=True)),
    }


def _draw_reslices(
    path: Path, name: str, poses: dict[str, RigidTransform], reference: Reference | None, strip: Strip
) -> Path:
    shown = dict(poses)
    if reference is not None and reference.covered.all():
        shown[reference.name] = reference.world_from_image
    left = RigidTransform.from_translation([strip.left_mm, 0.0, 0.0])
    cuts = {}
    for mode, world_from_image in shown.items():
        of_strip = world_from_image * left
        plane = middle_plane(of_strip, strip.grid)
        cuts[mode] = cut_frames(strip, strip.grid, of_strip, plane), plane
    return save_figure(figure_reslice(cuts, title=f"{name}: along the sweep, at the middle vector"), path)
