"""A sweep file in, a folder of results out: what ``speckle3d reconstruct`` does."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.config import Config
from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.reconstruction import Provenance, Trust
from speckle3d.core.sweep import Sweep
from speckle3d.correction.drift import DriftCorrection
from speckle3d.correction.modes import require_modes
from speckle3d.imaging.reslice import along_sweep_plane, reslice_frames
from speckle3d.io.calibrations import apply_calibrations
from speckle3d.io.hdf5 import PathLike, make_folder, sha256_of
from speckle3d.io.reconstructions import ReconstructionWriter
from speckle3d.matching.quality import describe
from speckle3d.motion.direction import sensed_orientation
from speckle3d.pipeline import Progress, Tracked, correct, track
from speckle3d.scoring.lengths import END_FRAMES, ModeError, accumulated, compare_modes
from speckle3d.study.blockfiles import BlockFiles
from speckle3d.study.figures import figure_drift, figure_reslice, save_figure
from speckle3d.study.strip import Strip
from speckle3d.study.summary import Summary, table_text, write_summary

REFERENCES = ("tracker", "truth")
SUBSET = "image+subset"
"""Mode of the images alone with the patches that contradict the sensed orientation left out."""


@dataclass(frozen=True)
class Reference:
    """What the modes are compared with."""

    name: str
    world_from_image: RigidTransform
    covered: BoolArray


@dataclass(frozen=True)
class JobResult:
    """What a job found, and where it is."""

    directory: Path
    summary: Summary
    table: str
    files: tuple[Path, ...]
    seconds: float


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
    """Reconstruct a sweep and write everything that belongs to it into `directory`.

    Written: ``reconstruction.h5``, ``summary.json``, ``table.txt``, ``table.csv``, ``drift.png`` and
    ``reslice.png``; each appears whole or not at all.

    Parameters
    ----------
    drift : sequence of str
        Modes beside `image`: "image+subset", "orientation", "pose".
    reference : {"tracker", "truth"}, optional
        What to compare with; by default the truth if stored, else the tracker, else nothing.
    calibrations : sequence of path
        Calibration files, at most one for each sensor, in place of what the sweep says of its sensors.
    blocks : BlockFiles, optional
        Blocks of the sweep that have been matched already.
    """
    settings = config or Config()
    began = time.perf_counter()
    sweep, mounted = apply_calibrations(sweep, calibrations)
    compared = require_possible(sweep, drift, reference, settings)
    fitted = [mode for mode in drift if mode != SUBSET]
    make_folder(directory)
    strip = Strip(sweep, settings)
    path = directory / "reconstruction.h5"
    with ReconstructionWriter(path, sweep.frame_time_s, sweep.grid) as writer:
        held = None if blocks is None else partial(blocks.read, strip=strip)
        tracked = track(sweep, curves, settings, progress, writer.append_pairs, strip.keep, held)
        corrections = correct(tracked, sweep, fitted, settings)
        poses = {"image": tracked.image}
        if SUBSET in drift and tracked.subset is not None:
            poses[SUBSET] = tracked.subset
        poses |= {mode: c.poses for mode, c in corrections.items()}
        provenance = Provenance(str(source), sha256_of(source), version("speckle3d"), mounted)
        writer.finish(poses, provenance, settings.to_toml(), Trust(tracked.covariance, tracked.flags))
    summary = _summarise(sweep, tracked, corrections, poses, compared, provenance)
    files = [path, *write_summary(directory, [summary])]
    files += _draw(directory, sweep, poses, compared, strip, tracked.covariance)
    return JobResult(directory, summary, table_text([summary]), tuple(files), time.perf_counter() - began)


def require_possible(
    sweep: Sweep, drift: Sequence[str], reference: str | None, config: Config
) -> Reference | None:
    """Check that a sweep has what is asked of it, before any work is done; returns the reference.

    Raises
    ------
    InvalidInputError, InsufficientDataError
        Naming the mode or the reference that cannot be.
    """
    require_modes(sweep, [mode for mode in drift if mode != SUBSET])
    if SUBSET in drift:
        _require_subset(sweep, config)
    return find_reference(sweep, reference)


def available_modes(sweep: Sweep, config: Config) -> list[str]:
    """Modes beside `image` for which the sweep has sensors, calibrated to the image."""
    found = [SUBSET] if sensed_orientation(sweep, config.sensors) is not None else []
    for mode in ("orientation", "pose"):
        try:
            require_modes(sweep, [mode])
        except InsufficientDataError:
            continue
        found.append(mode)
    return found


def _require_subset(sweep: Sweep, config: Config) -> None:
    if sensed_orientation(sweep, config.sensors) is None:
        raise InsufficientDataError(
            f"{sweep.name}: mode {SUBSET}: expected sensed orientation over every frame and the setting "
            "sensors.consistent_subset, got none"
        )


def find_reference(sweep: Sweep, wanted: str | None) -> Reference | None:
    """The poses that modes are compared with.

    Raises
    ------
    InsufficientDataError
        If the wanted reference is not in the sweep.
    """
    if wanted is not None and wanted not in REFERENCES:
        raise InvalidInputError(f"expected a reference among {', '.join(REFERENCES)}; got {wanted!r}")
    if sweep.truth is not None and wanted != "tracker":
        return Reference("truth", sweep.truth, np.ones(len(sweep), dtype=bool))
    if wanted == "truth":
        raise InsufficientDataError(f"{sweep.name}: expected true poses in /truth, got none")
    if sweep.tracker is not None and sweep.tracker.sensor_from_image is not None:
        covered = sweep.tracker.covers(sweep.frame_time_s)
        if covered.sum() >= 2:
            poses = sweep.tracker.world_from_image(sweep.frame_time_s[covered])
            return Reference("tracker", poses, covered)
    if wanted == "tracker":
        raise InsufficientDataError(f"{sweep.name}: expected a calibrated tracker over the frames, got none")
    return None


def _summarise(
    sweep: Sweep,
    tracked: Tracked,
    corrections: dict[str, DriftCorrection],
    poses: dict[str, RigidTransform],
    reference: Reference | None,
    provenance: Provenance,
) -> Summary:
    estimates = _estimates(poses, sweep)
    rows = [ModeError.of_estimate(mode, len(sweep), e["length_mm"]) for mode, e in estimates.items()]
    if reference is not None:
        rows = compare_modes(
            poses,
            reference.world_from_image,
            sweep.grid.centre_mm,
            reference.covered,
            end_frames=1 if reference.name == "truth" else END_FRAMES,
        )
    details: dict[str, Any] = {
        "provenance": provenance,
        "estimates": estimates,
        "pairs": tracked.pairs,
        "flagged_frames": describe(tracked.flags),
        "rejected_patch_share": tracked.rejected_share,
        "direction": tracked.direction,
        "direction_from": tracked.direction_from,
        "coherence": _coherence_details(tracked),
        "seconds_by_stage": tracked.times.seconds,
        "corrections": {mode: _fit_details(c) for mode, c in corrections.items()},
    }
    return Summary(
        sweep.name,
        reference.name if reference else "none",
        len(sweep),
        float(reference.covered.mean()) if reference else 0.0,
        rows,
        details,
    )


def _estimates(poses: dict[str, RigidTransform], sweep: Sweep) -> dict[str, dict[str, float]]:
    """Length and turns of the whole sweep in each mode."""
    found = {mode: accumulated(each, sweep.grid.centre_mm) for mode, each in poses.items()}
    return {
        mode: {
            "length_mm": float(motion.length_mm[-1]),
            **{
                f"{name}_deg": float(np.rad2deg(getattr(motion, f"{name}_rad")[-1]))
                for name in ("tilt", "yaw", "roll")
            },
        }
        for mode, motion in found.items()
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


def _draw(
    directory: Path,
    sweep: Sweep,
    poses: dict[str, RigidTransform],
    reference: Reference | None,
    strip: Strip,
    covariance: FloatArray,
) -> list[Path]:
    drift = figure_drift(
        poses,
        sweep.grid.centre_mm,
        reference.world_from_image if reference else None,
        reference.covered if reference else None,
        reference.name if reference else "reference",
        sweep.name,
        covariance,
    )
    shown = dict(poses)
    if reference is not None and reference.covered.all():
        shown[reference.name] = reference.world_from_image
    left = RigidTransform.from_translation([strip.left_mm, 0.0, 0.0])
    images, extents = {}, {}
    for mode, world_from_image in shown.items():
        images[mode], extents[mode] = _reslice(strip, world_from_image * left)
    reslice = figure_reslice(images, extents, title=f"{sweep.name}: along the sweep, at the middle vector")
    return [
        save_figure(drift, directory / "drift.png"),
        save_figure(reslice, directory / "reslice.png"),
    ]


def _reslice(
    strip: Strip, world_from_image: RigidTransform
) -> tuple[Float32Array, tuple[float, float, float, float]]:
    plane = along_sweep_plane(world_from_image, strip.grid, strip.grid.width_mm / 2, pixel_mm=0.1)
    plane = replace(plane, height_mm=min(plane.height_mm, 200.0), width_mm=min(plane.width_mm, 400.0))
    steps = np.abs(np.diff((world_from_image[0].inv() * world_from_image).translation[:, 2]))
    reach = max(0.3, 2.0 * float(np.percentile(steps, 99)))
    image = reslice_frames(strip, strip.grid, world_from_image, plane, reach)
    return image, (0.0, plane.width_mm, plane.height_mm, 0.0)
