"""Reconstruct one sweep into a folder of results: what ``speckle3d reconstruct`` does."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from scipy.spatial.transform import RigidTransform

from speckle3d.config import Config
from speckle3d.core.arrays import Float32Array
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import FileError, InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.printable import written_path
from speckle3d.core.progress import Progress, after
from speckle3d.core.reconstruction import FramePairs, Provenance, Reconstruction, SourceFile
from speckle3d.core.shown import shown
from speckle3d.core.sweep import Sweep
from speckle3d.correction.crossing.pair import CrossedPair, crossed
from speckle3d.correction.crossing.stack import ImageStack
from speckle3d.correction.modes import PUBLISHED
from speckle3d.corrections import Correction, correct
from speckle3d.crossing_sweeps import crossing_side, curves_from, require_pair, stack_for
from speckle3d.examine.disagreements import differing_lengths
from speckle3d.examine.sensors import believed, require_believed
from speckle3d.io.calibrations import apply_calibrations
from speckle3d.io.fileset import FileSet
from speckle3d.io.hdf5 import PathLike
from speckle3d.io.load import import_record, kind_of, load_landmarks, load_sweep, recording_sha256
from speckle3d.io.reconstructions import FORMAT as RECONSTRUCTION
from speckle3d.io.reconstructions import write_reconstruction
from speckle3d.pipeline import Tracked, track
from speckle3d.scoring.displacements import score_row
from speckle3d.scoring.lengths import TRACKER
from speckle3d.scoring.modes import length_claims, relative_claims
from speckle3d.scoring.references import Reference, error_rows, sweep_curves, tracker_alone
from speckle3d.study.details import details_of, doubted_modes, trust_of
from speckle3d.study.figures import figure_drift, save_figure
from speckle3d.study.images import Strip
from speckle3d.study.request import SUBSET, require_possible
from speckle3d.study.reslices.reslice_figures import draw_strip
from speckle3d.study.results import SUMMARY_FILES, Summary, is_study, require_own, summary_text, write_summary


@shown
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
    seconds : float
        It took.
    curves : DecorrelationCurves or None
        Corrected by the crossing sweep; None without one, or if it was refused.
    """

    directory: Path
    summary: Summary
    table: str
    seconds: float
    curves: DecorrelationCurves | None = None


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
    """Reconstruct a sweep and put everything that belongs to it into `directory`.

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
    began, settings = time.perf_counter(), config or Config()
    source, directory = Path(source), Path(directory)
    require_own_results(directory)
    sweep, mounted = apply_calibrations(sweep, calibrations)
    compared = require_possible(sweep, drift, reference, settings, crossing is not None)
    strip, sweeps, second_file = Strip(sweep, settings), [sweep], None
    if crossing is not None:
        sweeps.append(apply_calibrations(crossing[0], calibrations)[0])
        second_file = SourceFile(written_path(crossing[1]), recording_sha256(crossing[1]))
        require_pair(*sweeps)
    stacks = [] if crossing is None else [stack_for(each, settings) for each in sweeps]
    pair, corrected, refusal = None, None, ""
    with RESULTS.replaced(directory) as part:
        pairs = list[FramePairs]()

        def keep(index: int, intensity: Float32Array) -> None:
            strip.keep(index, intensity)
            if stacks:
                stacks[0].keep(index, intensity)

        report = after(progress, 0, sum(map(len, sweeps)))
        tracked = track(sweep, curves, settings, report, pairs.append, keep)
        if stacks:
            try:
                pair, corrected = _crossed(sweeps, stacks, tracked, curves, settings, progress)
            except (InsufficientDataError, MismatchError) as error:
                refusal = f"{sweep.name}: drift mode crossed: {error}"
        poses, corrections, left_out = _corrected(tracked, sweep, drift, settings, pair, refusal)
        provenance = Provenance(
            written_path(source),
            recording_sha256(source),
            version("speckle3d"),
            mounted,
            second_file,
            import_record(source),
        )
        trust = trust_of(tracked, corrections)
        made = Reconstruction(
            sweep.frame_time_s, sweep.grid, poses, provenance, settings.to_toml(), trust=trust
        )
        write_reconstruction(part / RESULTS.primary, made, pairs)
        # The tracker alone is shown beside the modes, but is none of the reconstruction's.
        alone = tracker_alone(believed(sweep, tracked.doubts))
        if reference is None and compared is not None and compared.name == TRACKER:
            compared = compared if believed(sweep, tracked.doubts).tracker is not None else None
        every = poses if alone is None else {**poses, TRACKER: alone}
        centre = sweep.grid.centre_mm
        drawn = poses if compared is None or compared.name == TRACKER else every
        moved = sweep_curves(drawn, centre, compared, tracked.covariance)
        claims = relative_claims(poses, trust, centre)
        doubts = (*tracked.doubts, *differing_lengths(length_claims(poses, trust, centre)))
        rows = [
            replace(row, sigma_mm=claims[row.mode] * abs(row.estimate_mm)) if row.mode in claims else row
            for row in error_rows(every, compared, centre)
        ]
        details = details_of(tracked, corrections, provenance)
        summary = Summary(
            sweep.name,
            "none" if compared is None else compared.name,
            len(sweep),
            0.0 if compared is None else float(compared.covered.mean()),
            rows,
            details,
            doubts,
            doubted_modes(sweep, doubts, every),
            left_out,
            claims,
            _drift(every, compared, sweep, source),
        )
        save_figure(figure_drift(moved, _title(summary)), part / PICTURES[0])
        draw_strip(strip, every, compared, sweep.name, rows, (part / PICTURES[1], part / PICTURES[2]))
        details["seconds"] = time.perf_counter() - began
        write_summary(part, summary)
    return JobResult(directory, summary, summary_text([summary]), details["seconds"], corrected)


def _crossed(
    sweeps: Sequence[Sweep],
    stacks: Sequence[ImageStack],
    tracked: Tracked,
    curves: DecorrelationCurves,
    config: Config,
    progress: Progress | None,
) -> tuple[CrossedPair, DecorrelationCurves]:
    """Track the second sweep and cross it with the first, which is tracked; the curves corrected by it.

    Raises
    ------
    MismatchError, InsufficientDataError
        As `cross_sweeps`.
    """
    shown = after(progress, len(sweeps[0]), sum(map(len, sweeps)))
    both = tracked, track(sweeps[1], curves, config, shown, images=stacks[1].keep)
    sides = [crossing_side(*each, config) for each in zip(sweeps, both, stacks, strict=True)]
    pair = crossed(sides[0], sides[1], config.crossing)
    return pair, curves_from(both, pair, curves)


def require_own_results(directory: Path) -> None:
    """Refuse a folder in which a job's names stand for something else.

    Raises
    ------
    InvalidInputError
        Naming the first such file.
    """
    primary = directory / RESULTS.primary
    try:
        is_own = primary.is_file() and not is_study(directory) and kind_of(primary) == RECONSTRUCTION
    except (FileError, InvalidInputError):
        is_own = False
    require_own(directory, RESULTS, is_own, "the results of `reconstruct` to replace")


def _corrected(
    tracked: Tracked,
    sweep: Sweep,
    modes: Sequence[str],
    config: Config,
    pair: CrossedPair | None,
    refusal: str,
) -> tuple[dict[str, RigidTransform], dict[str, Correction], dict[str, str]]:
    """Poses by mode, corrections by mode, and why modes are left out.

    Parameters
    ----------
    refusal : str
        Why the sweeps could not be crossed; empty if they were, or need not be.
    """
    poses, corrections = {"image": tracked.image}, dict[str, Correction]()
    # Said even if only `fused` was to use it: it went without.
    left_out = {"crossed": refusal} if refusal else {}
    for mode in modes:
        where = f"{sweep.name}: mode {mode}" if mode == SUBSET else f"{sweep.name}: drift mode {mode}"
        try:
            if mode == SUBSET and tracked.subset is not None:
                poses[mode] = tracked.subset
            elif mode == SUBSET:
                require_believed(tracked.doubts, sweep.orientation_source, where)
                left_out[mode] = (
                    f"{where}: expected readings over every frame, got gaps where some are left out"
                )
            elif mode not in left_out:
                corrections |= correct(tracked, sweep, [mode], config, pair)
        except (MismatchError, InsufficientDataError) as error:
            if mode in PUBLISHED and isinstance(error, InsufficientDataError):
                raise
            left_out[mode] = str(error) if str(error).startswith(sweep.name) else f"{where}: {error}"
    return poses | {mode: each.poses for mode, each in corrections.items()}, corrections, left_out


def _title(summary: Summary) -> str:
    """Name of the sweep and the modes in doubt, for figures."""
    doubted = [f"{mode} in doubt: {why}" for mode, why in summary.doubted.items()]
    return "; ".join([summary.sweep, *doubted, *(f"{mode} left out" for mode in summary.left_out)])


def _drift(
    poses: Mapping[str, RigidTransform], reference: Reference | None, sweep: Sweep, source: Path
) -> list[dict[str, Any]]:
    """Drift and displacement of every mode over the frames that have a reference."""
    if reference is None:
        return []
    true, covered = reference.world_from_image, reference.covered
    # Landmarks could fall into gaps of the reference; of a part of a recording they have other numbers.
    marks = load_landmarks(source) if covered.all() else None
    marks = marks if marks is None or len(load_sweep(source)) == len(sweep) else None
    with suppress(InsufficientDataError):  # a reference at rest
        return [
            {"mode": mode, **score_row(each[covered], true, sweep.grid, marks)}
            for mode, each in poses.items()
            if mode != reference.name
        ]
    return []
