"""Reconstruct one sweep into a folder of results: what ``speckle3d reconstruct`` does."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.calibration_files import apply_calibrations
from speckle3d.config import Config
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.core.progress import Progress, after
from speckle3d.core.reconstruction import (
    FramePairs,
    ModeErrors,
    Provenance,
    Reconstruction,
    SourceFile,
    Trust,
)
from speckle3d.core.sweep import Sweep
from speckle3d.core.text import shown, written_path
from speckle3d.correction.crossing.pair import CrossedPair
from speckle3d.correction.drift import DriftCorrection
from speckle3d.correction.modes import CUBIC_MODES, require_modes
from speckle3d.corrections import Correction, correct
from speckle3d.crossing_sweeps import cross_with, require_pair, stack_for
from speckle3d.examine.disagreements import differing_lengths
from speckle3d.examine.frames import describe
from speckle3d.examine.sensors import credible_sensors, repair_readings, require_credible
from speckle3d.io.family.reconstructions import write_reconstruction
from speckle3d.io.fileset import FileSet
from speckle3d.io.hdf5 import PathLike
from speckle3d.io.load import import_record, load_landmarks, load_sweep, recording_sha256
from speckle3d.motion.sensors import sensed_orientation
from speckle3d.scoring.displacements import score_row
from speckle3d.scoring.lengths import TRACKER, jitter_of, sum_motion
from speckle3d.scoring.modes import length_claims
from speckle3d.scoring.references import (
    Reference,
    error_rows,
    find_reference,
    sweep_curves,
    tracker_alone,
)
from speckle3d.study.figures import figure_drift, save_figure
from speckle3d.study.posed import PosedSweep, SweepModes, pose_mark
from speckle3d.study.reslices.cuts import length_words
from speckle3d.study.reslices.reslice_figures import draw_along
from speckle3d.study.results import SUMMARY_FILES, Summary, require_own, summary_text, write_summary
from speckle3d.tracked import Tracked
from speckle3d.tracking import track


@shown
@dataclass(frozen=True)
class JobResult:
    """Results of a job, and the folder that holds them.

    Attributes
    ----------
    directory : path
        The folder of results.
    summary : Summary
        Errors by part and mode, and details of the reconstruction.
    curves : DecorrelationCurves or None
        Corrected by the crossing sweep; None without one, or if it was refused.
    """

    directory: Path
    summary: Summary
    curves: DecorrelationCurves | None = None

    @property
    def table(self) -> str:
        """Table of the errors as text."""
        return summary_text([self.summary])

    @property
    def seconds(self) -> float:
        """Run time of the job."""
        return float(self.summary.details["seconds"])


SUBSET = "consistent-subset"
"""Mode of the images alone with the patches that contradict the sensed orientation left out."""

PICTURES = ("drift.png", "reslice.png", "enlarged.png")
RESULTS = FileSet("reconstruction.h5", (*SUMMARY_FILES, *PICTURES))
"""What a job writes."""


def run_job(
    sweep: Sweep,
    source: PathLike,
    curves: DecorrelationCurves,
    directory: PathLike,
    drift: Sequence[str] = (),
    reference: str | None = None,
    config: Config | None = None,
    progress: Progress | None = None,
    calibrations: Sequence[PathLike] = (),
    crossing: tuple[Sweep, Path] | None = None,
) -> JobResult:
    """Reconstruct a sweep and write all results into `directory`.

    Written: ``reconstruction.h5``, ``summary.json``, ``table.txt``, ``table.csv``, ``drift.png``,
    ``reslice.png`` and ``enlarged.png``. A new folder appears whole; in one that is there, all of them take
    the place of earlier results together, and other files stay.

    Parameters
    ----------
    sweep : Sweep
    source : path
        The sweep's file, whose SHA-256 goes into the results.
    curves : DecorrelationCurves
    directory : path
        Made if need be.
    drift : sequence of str
        Modes beside `image`: "consistent-subset", "orientation", "pose", "crossed", "fused".
    reference : {"tracker", "truth"}, optional
        What to compare with; by default the truth if stored, else the tracker, else nothing.
    config : Config, optional
    progress : callable, optional
        Called with the number of frames done and of all.
    calibrations : sequence of path
        Calibration files, at most one for each sensor, in place of what the sweep says of its sensors.
    crossing : tuple of Sweep and path, optional
        A second sweep over the same tissue and its file, for the modes "crossed" and "fused".

    Returns
    -------
    JobResult

    Raises
    ------
    InvalidInputError, InsufficientDataError
        If the sweep lacks what a mode or the reference needs, or the folder holds other files of these
        names. A mode whose sensor the images or its own readings refute, or whose data do not determine the
        length, is left out of the results instead; `Summary.left_out` says why.
    FileError
        If the folder cannot be written, or another run is at work in it.
    """
    start_s, settings = time.perf_counter(), config or Config()
    source, directory = Path(source), Path(directory)
    require_own(directory, RESULTS)
    sweep, calibration_files = apply_calibrations(sweep, calibrations)
    reference_poses = require_possible(sweep, drift, reference, settings, crossing is not None)
    second, second_file, stack = None, None, None
    if crossing is not None:
        second = apply_calibrations(crossing[0], calibrations)[0]
        second_file = SourceFile(written_path(crossing[1]), recording_sha256(crossing[1]))
        require_pair(sweep, second)
        stack = stack_for(sweep, settings)
    pair, new_curves, left_out = None, None, dict[str, str]()
    with RESULTS.replaced(directory) as part:
        pairs, keep = list[FramePairs](), None if stack is None else stack.keep
        report = after(progress, 0, len(sweep) + (0 if second is None else len(second)))
        tracked = track(sweep, curves, settings, report, pairs.append, keep)
        if second is not None and stack is not None:
            try:
                pair, new_curves = cross_with(second, sweep, tracked, stack, curves, settings, progress)
            except (InsufficientDataError, MismatchError) as error:
                # Said even if only `fused` was to use it: it went without.
                left_out["crossed"] = f"{sweep.name}: drift mode crossed: {error}"
        poses, corrections = _correct_modes(tracked, sweep, drift, settings, pair, left_out)
        provenance = Provenance(
            written_path(source),
            recording_sha256(source),
            version("speckle3d"),
            calibration_files,
            second_file,
            import_record(source),
        )
        errors = {mode: ModeErrors(c.covariance, c.length_sigma) for mode, c in corrections.items()}
        trust = Trust(tracked.covariance, tracked.flags, tracked.shared, errors)
        reconstruction = Reconstruction(
            sweep.frame_time_s, sweep.grid, poses, provenance, settings.to_toml(), trust=trust
        )
        write_reconstruction(part / RESULTS.primary, reconstruction, pairs)
        # The tracker alone is shown beside the modes, but is none of the reconstruction's.
        credible = credible_sensors(sweep, tracked.doubts)
        tracker_poses, centre = tracker_alone(credible), sweep.grid.centre_mm
        if reference is None and credible.tracker is None:
            reference_poses = find_reference(credible)
        estimates = poses if tracker_poses is None else {**poses, TRACKER: tracker_poses}
        lengths = length_claims(poses, trust, centre)
        claims = {mode: sigma / length for mode, (length, sigma) in lengths.items()}
        doubts = (*tracked.doubts, *differing_lengths(lengths))
        rows = [
            replace(row, sigma_mm=claims[row.mode] * abs(row.estimate_mm)) if row.mode in claims else row
            for row in error_rows(estimates, reference_poses, centre, _jitter_of_slow_tracker(credible))
        ]
        details = _details_of(tracked, corrections, provenance)
        summary = Summary(
            sweep.name,
            "none" if reference_poses is None else reference_poses.name,
            len(sweep),
            0.0 if reference_poses is None else float(reference_poses.covered.mean()),
            rows,
            details,
            doubts,
            left_out,
            claims,
            _drift_rows(estimates, reference_poses, sweep, source),
        )
        motion = sweep_curves(estimates, centre, reference_poses, tracked.covariance)
        save_figure(figure_drift(motion, _title(summary)), part / PICTURES[0])
        panels, base = dict(estimates), "image"
        if reference_poses is not None and reference_poses.covered.all():
            panels[reference_poses.name], base = reference_poses.world_from_image, reference_poses.name
        posed = PosedSweep(sweep, np.arange(len(sweep)), poses["image"], "image", reconstruction)
        modes = SweepModes(posed, panels, base, {mode: pose_mark(path) for mode, path in panels.items()})
        draw_along(modes, length_words(rows, base), (part / PICTURES[1], part / PICTURES[2]))
        details["seconds"] = time.perf_counter() - start_s
        write_summary(part, summary)
    return JobResult(directory, summary, new_curves)


def require_possible(
    sweep: Sweep, modes: Sequence[str], reference: str | None, config: Config, crossing: bool = False
) -> Reference | None:
    """Check that a sweep has what modes and reference need, and return the reference's poses.

    Parameters
    ----------
    crossing : bool
        Whether there is a crossing sweep.

    Raises
    ------
    InvalidInputError, InsufficientDataError
        If it does not have it, naming the mode or the reference.
    """
    require_modes(sweep, [mode for mode in modes if mode != SUBSET], crossing)
    if SUBSET in modes and sensed_orientation(sweep, config.sensors) is None:
        raise InsufficientDataError(
            f"{sweep.name}: mode {SUBSET}: expected sensed orientation within sensors.smooth_s of every "
            "frame and the setting sensors.consistent_subset, got none"
        )
    return find_reference(repair_readings(sweep)[0] if config.sensors.examine else sweep, reference)


def available_modes(sweep: Sweep, config: Config) -> Sequence[str]:
    """Modes beside `image` that need no more than the sweep's sensors, calibrated to the image."""
    possible = []
    for mode in (SUBSET, "orientation", "pose", "fused"):
        with suppress(InsufficientDataError):
            require_possible(sweep, [mode], None, config)
            possible.append(mode)
    return possible


def _correct_modes(
    tracked: Tracked,
    sweep: Sweep,
    modes: Sequence[str],
    config: Config,
    pair: CrossedPair | None,
    left_out: dict[str, str],
) -> tuple[dict[str, RigidTransform], dict[str, Correction]]:
    """Poses by mode and corrections by mode; modes that are refused go to `left_out`, with the reason."""
    poses, corrections = {"image": tracked.image}, dict[str, Correction]()
    for mode in modes:
        where = f"{sweep.name}: mode {mode}" if mode == SUBSET else f"{sweep.name}: drift mode {mode}"
        try:
            if mode == SUBSET and tracked.subset is not None:
                poses[mode] = tracked.subset
            elif mode == SUBSET:
                require_credible(tracked.doubts, sweep.orientation or sweep.tracker, where)
                left_out[mode] = (
                    f"{where}: expected readings over every frame, got gaps where some are left out"
                )
            elif mode not in left_out:
                corrections |= correct(tracked, sweep, [mode], config, pair)
        except (MismatchError, InsufficientDataError) as error:
            if mode in CUBIC_MODES and isinstance(error, InsufficientDataError):
                raise
            left_out[mode] = str(error) if str(error).startswith(sweep.name) else f"{where}: {error}"
    return poses | {mode: correction.poses for mode, correction in corrections.items()}, corrections


def _title(summary: Summary) -> str:
    """Name of the sweep and what is in doubt, for figures."""
    suspects = ", ".join(dict.fromkeys(doubt.suspect for doubt in summary.doubts if doubt.suspect))
    return f"{summary.sweep}; in doubt: {suspects}" if suspects else summary.sweep


def _jitter_of_slow_tracker(sweep: Sweep) -> float | None:
    """Jitter, mm, of a tracker slower than the images, as if each frame had a reading; None of any other.

    Poses at the frames lie between its readings, on lines that hide most of it. NaN of too few readings.
    """
    tracker, times = sweep.tracker, sweep.frame_time_s
    if tracker is None or tracker.sensor_from_image is None:
        return None
    reading_s = tracker.readings.time_s + tracker.time_offset_s
    during = (reading_s >= times[0]) & (reading_s <= times[-1])
    if (count := int(during.sum())) >= len(times):
        return None
    if count < 2:
        return np.nan
    poses = tracker.readings.world_from_sensor[during] * tracker.sensor_from_image
    length_mm = sum_motion(poses, sweep.grid.centre_mm).length_mm
    return float(jitter_of(length_mm) * np.sqrt(len(times) / count))


def _drift_rows(
    poses: Mapping[str, RigidTransform], reference: Reference | None, sweep: Sweep, source: Path
) -> list[dict[str, Any]]:
    """Drift and displacement of every mode over the frames that have a reference."""
    if reference is None:
        return []
    true, mask = reference.world_from_image, reference.covered
    # Landmarks could fall into gaps of the reference; of a part of a recording they have other numbers.
    marks = load_landmarks(source) if mask.all() else None
    marks = marks if marks is None or len(load_sweep(source)) == len(sweep) else None
    with suppress(InsufficientDataError):  # a reference at rest
        return [
            {"mode": mode, **score_row(path[mask], true, sweep.grid, marks)}
            for mode, path in poses.items()
            if mode != reference.name
        ]
    return []


def _details_of(
    tracked: Tracked, corrections: Mapping[str, Correction], provenance: Provenance
) -> dict[str, Any]:
    """Details of a reconstruction beside its errors, by name."""
    fits: dict[str, dict[str, Any]] = {}
    for mode, fit in corrections.items():
        if isinstance(fit, DriftCorrection):
            parameters = dict(zip(fit.names, fit.fit.x.tolist(), strict=True))
            fits[mode] = {"curves": fit.settings.curves, "coverage": fit.coverage, "parameters": parameters}
        else:
            fits[mode] = {"length_over_images": fit.scale, "rests_on": fit.rests_on, **fit.details}
    return {
        "provenance": provenance,
        "pairs": len(tracked.edges),
        "flagged_frames": describe(tracked.flags),
        "rejected_patch_share": tracked.rejected_share,
        "direction": tracked.direction,
        "direction_from": tracked.direction_from,
        "corrections": fits,
    }
