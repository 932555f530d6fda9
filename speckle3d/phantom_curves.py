"""Decorrelation curves from phantom sweeps whose positions are known.

RF -> intensity -> in-plane motion -> patch correlation -> correlation against |distance|, by depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.spatial.transform import RigidTransform

from speckle3d.config import Config
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves, EchoSpectra, SpeckleSize
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.progress import Progress, after
from speckle3d.core.sweep import Sweep
from speckle3d.matching.frames import match_sweep
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.patches import PatchGrid
from speckle3d.matching.schedule import KnownSchedule
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.phantom import CurveSettings, PhantomSamples, fit_curves

SMOOTHED_FRAMES = 8
"""Frames from which a tracker's path is smoothed: a spline through fewer is none."""


def calibrate_curves(
    sweeps: Sequence[Sweep], config: Config | None = None, progress: Progress | None = None
) -> DecorrelationCurves:
    """Measure decorrelation curves on phantom sweeps whose positions are known.

    Parameters
    ----------
    sweeps : sequence of Sweep
        Fully developed speckle in steps or by hand; with some that turn, the curves learn what tilt does.
    config : Config, optional
    progress : callable, optional
        Called with frames done and frames in all.

    Returns
    -------
    DecorrelationCurves

    Raises
    ------
    InsufficientDataError
        If positions are not known, or the distances do not span the curves.
    MismatchError
        If the sweeps differ in probe, frequency or sampling.
    """
    settings = config or Config()
    if not sweeps:
        raise InsufficientDataError("expected at least one phantom sweep, got none")
    keys, samples, sizes, spectra, before = [], [], [], [], 0
    total = sum(len(sweep) for sweep in sweeps)
    for sweep in sweeps:
        matcher = FrameMatcher(sweep, settings)
        keys.append(matcher.key)
        keys[0].require_same(matcher.key, "the first phantom sweep's images")
        poses = known_positions(sweep)
        pairs = phantom_pairs(sweep, poses, settings.curves)
        matches = match_sweep(sweep, matcher, KnownSchedule(pairs), after(progress, before, total))
        samples.append(phantom_samples(poses, matcher.patches, matches.table, pairs))
        sizes.append((matcher.patches.row_depth_mm, matches.texture.speckle_size()))
        spectra.append(matches.texture.spectra())
        before += len(sweep)
    curves = fit_curves(keys[0], samples, settings.curves)
    return replace(
        curves,
        speckle=_mean_speckle(curves.depth_mm, sizes),
        spectrum=_mean_spectra([spectrum for spectrum in spectra if spectrum is not None]),
    )


def known_positions(sweep: Sweep) -> RigidTransform:
    """Poses of a phantom sweep's frames: the stored truth, or the tracker's, smoothed.

    A tracker's jitter is a good part of the distances wanted here. The probe moves more smoothly: a smoothing
    spline, its stiffness from generalised cross-validation, takes the jitter out.

    Raises
    ------
    InsufficientDataError
        If there is neither, or the tracker does not cover every frame.
    """
    if sweep.truth is not None:
        return sweep.truth
    if sweep.tracker is None:
        raise InsufficientDataError(
            f"{sweep.name}: expected a phantom sweep with known positions (/truth or /tracker), got neither"
        )
    poses, time_s = sweep.tracker.world_from_image(sweep.frame_time_s), sweep.frame_time_s
    if len(poses) < SMOOTHED_FRAMES:
        return poses
    motion = (poses[0].inv() * poses).as_exp_coords()
    smooth = np.stack([make_smoothing_spline(time_s, values)(time_s) for values in motion.T], axis=1)
    return poses[0] * RigidTransform.from_exp_coords(smooth)


def phantom_pairs(sweep: Sweep, poses: RigidTransform, settings: CurveSettings) -> IntArray:
    """Choose frame pairs of a phantom sweep that are within the curves' reach, shape (m, 2).

    Raises
    ------
    InsufficientDataError
        If no frames are near enough to each other.
    """
    centres, normals = poses.apply(sweep.grid.centre_mm), poses.rotation.apply([0.0, 0.0, 1.0])
    first, second = np.triu_indices(len(poses), 1)
    separation = np.abs(((centres[second] - centres[first]) * normals[first]).sum(axis=1))
    order = np.argsort(separation, kind="stable")[: int((separation <= settings.largest_mm).sum())]
    if not order.size:
        raise InsufficientDataError(
            f"{sweep.name}: expected phantom frames closer than {settings.largest_mm:g} mm, got none"
        )
    # Thinned evenly over separation.
    thin = order[np.linspace(0, order.size - 1, min(order.size, settings.pairs)).astype(int)]
    return np.asarray(np.column_stack([first, second])[np.sort(thin)])


def phantom_samples(
    poses: RigidTransform, patches: PatchGrid, table: CorrelationTable, pairs: IntArray
) -> PhantomSamples:
    """Set the correlations of matched phantom frames beside their known distances.

    Parameters
    ----------
    table : CorrelationTable
    pairs : ndarray, shape (m, 2)
        Those of the table that count.
    """
    rows = np.isin(table.first * len(poses) + table.second, pairs @ [len(poses), 1])
    first, second, correlation = table.first[rows], table.second[rows], table.correlation[rows]
    normal = (poses[first].inv() * poses[second]).as_matrix()[:, 2]
    at = patches.centre_mm - table.inplane[rows, None, :2]
    offset = (at * normal[:, None, :2]).sum(axis=2) + normal[:, 3:]
    tilt = normal[:, :1] * np.sin(patches.angle_rad) + normal[:, 1:2] * np.cos(patches.angle_rad)
    depth = np.broadcast_to(patches.depth_mm, tilt.shape)
    return PhantomSamples(
        depth.ravel(), offset.ravel(), tilt.ravel(), correlation.ravel().astype(float), len(first)
    )


def _mean_speckle(
    depth_mm: FloatArray, sizes: Sequence[tuple[FloatArray, SpeckleSize]]
) -> SpeckleSize | None:
    """Mean speckle size of phantom sweeps at the depths of the curves; None if unknown."""
    means = []
    for name in ("lateral_mm", "axial_mm"):
        by_depth = [(depths, getattr(size, name)) for depths, size in sizes]
        finite = [(depths[f], size[f]) for depths, size in by_depth if (f := np.isfinite(size)).any()]
        if not finite:
            return None
        means.append(np.mean([np.interp(depth_mm, *sweep) for sweep in finite], axis=0))
    return SpeckleSize(*means)


def _mean_spectra(spectra: Sequence[EchoSpectra]) -> EchoSpectra | None:
    """Mean of some sweeps' spectra at the depths of the first; None of none."""
    if not spectra:
        return None
    first = spectra[0]
    power = np.mean([spectrum.at(first.depth_mm, first.frequency_hz) for spectrum in spectra], axis=0)
    return EchoSpectra(first.depth_mm, first.frequency_hz, power)
