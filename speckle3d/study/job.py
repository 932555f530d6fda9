"""Reconstruct one sweep into a folder of results: what ``speckle3d reconstruct`` does."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.config import Config
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import FileError, InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.printable import written_path
from speckle3d.core.progress import Progress, after
from speckle3d.core.reconstruction import Provenance
from speckle3d.core.shown import shown
from speckle3d.core.sweep import Sweep
from speckle3d.correction.crossing.pair import CrossedPair
from speckle3d.correction.modes import PUBLISHED
from speckle3d.corrections import Correction, correct
from speckle3d.examine.disagreements import differing_lengths
from speckle3d.examine.sensors import believed, require_believed
from speckle3d.io.calibrations import apply_calibrations
from speckle3d.io.fileset import FileSet
from speckle3d.io.hdf5 import PathLike
from speckle3d.io.load import import_record, kind_of, recording_sha256
from speckle3d.io.reconstructions import FORMAT as RECONSTRUCTION
from speckle3d.io.reconstructions import ReconstructionWriter
from speckle3d.pipeline import Tracked, track
from speckle3d.scoring.jitter import jitter_percent
from speckle3d.scoring.lengths import END_FRAMES, ModeError, compare_modes
from speckle3d.scoring.references import Reference, SweepCurves, sweep_curves
from speckle3d.study.crossed import Companion
from speckle3d.study.details import claims_of, details_of, doubted_modes, trust_of
from speckle3d.study.figures import figure_drift, save_figure
from speckle3d.study.folder import BlockFiles
from speckle3d.study.images import PIXEL_MM, Strip, cut_frames, middle_planes
from speckle3d.study.request import SUBSET, Request, require_possible
from speckle3d.study.reslices.cut_geometry import anchors_of
from speckle3d.study.reslices.cuts import CutPicture, DrawnCut
from speckle3d.study.reslices.enlarged import save_enlarged
from speckle3d.study.reslices.places import view_of
from speckle3d.study.reslices.reslice_figures import save_reslices
from speckle3d.study.results import Summary, is_study, summary_text, write_summary


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
    files : tuple of path
        What was written.
    seconds : float
        It took.
    curves : DecorrelationCurves or None
        Corrected by the crossing sweep; None without one, or if it was refused.
    """

    directory: Path
    summary: Summary
    table: str
    files: tuple[Path, ...]
    seconds: float
    curves: DecorrelationCurves | None = None


RESULTS = FileSet(
    "reconstruction.h5",
    ("summary.json", "table.txt", "table.csv", "drift.png", "reslice.png", "enlarged.png"),
)
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
    require_own_results(directory)
    request = Request(
        sweep, source, curves, tuple(drift), reference, config or Config(), tuple(calibrations), crossing
    )
    with RESULTS.replaced(directory) as part:
        made = write_results(request, part, progress)
    return replace(made, directory=directory, files=tuple(directory / each.name for each in made.files))


def write_results(
    request: Request, directory: Path, progress: Progress | None = None, blocks: BlockFiles | None = None
) -> JobResult:
    """Reconstruct a sweep into a folder that is there and that nobody reads yet; otherwise as `run_job`.

    Parameters
    ----------
    blocks : BlockFiles, optional
        Blocks of the sweep that have been matched already; not of one that is crossed.
    """
    settings, modes, source = request.config, request.modes, request.source
    began = time.perf_counter()
    sweep, mounted = apply_calibrations(request.sweep, request.calibrations)
    crossing = None
    if request.crossing is not None:
        crossing, _ = apply_calibrations(request.crossing[0], request.calibrations)
    compared = require_possible(sweep, modes, request.reference, settings, crossing is not None)
    strip = Strip(sweep, settings)
    side = None if crossing is None else Companion(sweep, crossing, request.curves, settings)
    path = directory / RESULTS.primary
    with ReconstructionWriter(path, sweep.frame_time_s, sweep.grid) as writer:
        held = None if blocks is None else partial(blocks.read, strip=strip)
        sink = strip.keep if side is None else side.beside(strip.keep)
        shown = progress if side is None else after(progress, 0, side.frames)
        tracked = track(sweep, request.curves, settings, shown, writer.append_pairs, sink, held)
        crossed, refusal = None, ""
        if side is not None:
            crossed, refusal = side.cross(tracked, progress)
        corrections, left_out = _corrected(tracked, sweep, modes, settings, crossed, refusal)
        poses = {"image": tracked.image}
        if tracked.subset is not None and SUBSET in modes:
            poses[SUBSET] = tracked.subset
        elif SUBSET in modes:
            left_out[SUBSET] = _refusal_of_subset(sweep, tracked)
        poses |= {mode: c.poses for mode, c in corrections.items()}
        provenance = Provenance(
            written_path(source),
            recording_sha256(source),
            version("speckle3d"),
            mounted,
            request.crossing_file,
            import_record(source),
        )
        writer.finish(poses, provenance, settings.to_toml(), trust_of(tracked, corrections))
    if request.reference is None and compared is not None and compared.name == "tracker":
        compared = compared if believed(sweep, tracked.doubts).tracker is not None else None
    moved = sweep_curves(poses, sweep.grid.centre_mm, compared, tracked.covariance)
    name, share = ("none", 0.0) if compared is None else (compared.name, float(compared.covered.mean()))
    claims = claims_of(tracked, sweep.grid.centre_mm, corrections)
    lengths = {m: float(np.abs(c[0, -1])) for m, c in moved.modes.items()}
    claimed = {m: (lengths[m], lengths[m] * sigma) for m, sigma in claims.items() if m in lengths}
    doubts = (*tracked.doubts, *differing_lengths(claimed))
    summary = Summary(
        sweep.name,
        name,
        len(sweep),
        share,
        _errors(sweep, poses, moved, compared),
        details_of(tracked, corrections, moved, provenance),
        doubts,
        doubted_modes(sweep, doubts, poses),
        left_out,
        claims,
        _jitter(sweep),
    )
    files = [path, *write_summary(directory, summary)]
    files += [save_figure(figure_drift(moved, _title(summary)), directory / "drift.png")]
    files += [_draw_reslices(directory / "reslice.png", sweep.name, poses, compared, strip)]
    files += [_draw_enlarged(directory / "enlarged.png", sweep, poses, strip)]
    table, seconds = summary_text(summary), time.perf_counter() - began
    curves = None if side is None or crossed is None else side.curves(tracked, crossed)
    return JobResult(directory, summary, table, tuple(files), seconds, curves)


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


def _corrected(
    tracked: Tracked,
    sweep: Sweep,
    modes: Sequence[str],
    config: Config,
    crossed: CrossedPair | None,
    refusal: str,
) -> tuple[dict[str, Correction], dict[str, str]]:
    """Corrections by mode, and why modes are left out.

    Parameters
    ----------
    refusal : str
        Why the sweeps could not be crossed; empty if they were, or need not be.
    """
    corrections: dict[str, Correction] = {}
    # Said even if only `fused` was to use it: it went without.
    left_out = {"crossed": refusal} if refusal else {}
    for mode in modes:
        if mode == SUBSET:
            continue
        if mode in left_out:
            continue
        try:
            corrections |= correct(tracked, sweep, [mode], config, crossed)
        except (MismatchError, InsufficientDataError) as error:
            if mode in PUBLISHED and isinstance(error, InsufficientDataError):
                raise
            where = f"{sweep.name}: drift mode {mode}"
            left_out[mode] = str(error) if str(error).startswith(sweep.name) else f"{where}: {error}"
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


def _jitter(sweep: Sweep) -> float:
    """Per cent of the length that a tracker's jitter alone may be; 0 without one over all frames."""
    tracker = sweep.tracker
    if tracker is None or tracker.sensor_from_image is None or not tracker.covers(sweep.frame_time_s).all():
        return 0.0
    found = jitter_percent(tracker.world_from_image(sweep.frame_time_s), sweep.grid.centre_mm)
    return found if np.isfinite(found) else 0.0


def _draw_enlarged(path: Path, sweep: Sweep, poses: dict[str, RigidTransform], strip: Strip) -> Path:
    """Part of the cut along the sweep: by the tracker alone, if it covers all frames, and in every mode."""
    left = RigidTransform.from_translation([strip.left_mm, 0.0, 0.0])
    shown, tracker = {}, sweep.tracker
    mounted = tracker is not None and tracker.sensor_from_image is not None
    if tracker is not None and mounted and tracker.covers(sweep.frame_time_s).all():
        shown["tracker"] = tracker.world_from_image(sweep.frame_time_s) * left
    shown |= {mode: each * left for mode, each in poses.items()}
    planes = middle_planes(shown, strip.grid)
    cuts = {mode: cut_frames(strip, strip.grid, each, planes[mode]) for mode, each in shown.items()}
    return save_enlarged(cuts, PIXEL_MM, sweep.name, path)


def _draw_reslices(
    path: Path, name: str, poses: dict[str, RigidTransform], reference: Reference | None, strip: Strip
) -> Path:
    left = RigidTransform.from_translation([strip.left_mm, 0.0, 0.0])
    shown = {mode: each * left for mode, each in poses.items()}
    compared = reference.name if reference is not None and reference.covered.all() else None
    if reference is not None and compared:
        shown[compared] = reference.world_from_image * left
    planes = middle_planes(shown, strip.grid)
    cuts = {}
    for mode, world_from_image in shown.items():
        image = cut_frames(strip, strip.grid, world_from_image, planes[mode])
        cuts[mode] = DrawnCut.of_sweep(image, planes[mode], strip.grid, world_from_image)
    first = next(iter(shown)) if len(shown) > 1 else None
    view = view_of(planes[compared or "image"], shown[compared or "image"])
    where = f"at lateral {strip.left_mm + strip.grid.width_mm / 2:.4g} mm, {view}".removesuffix(", ")
    anchors = {mode: anchors_of(world_from_image) for mode, world_from_image in poses.items()}
    picture = CutPicture(cuts, place=where, reference=compared or first, name=name, anchors=anchors)
    return save_reslices(picture, path)
