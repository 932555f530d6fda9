"""Correlations between phantom frames at known positions, for the decorrelation curves."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.curves import SpeckleSize
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.sweep import Sweep
from speckle3d.matching.inplane import InPlaneMotion
from speckle3d.matching.patches import PatchGrid
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.decorrelation import CurveSettings, PhantomSamples


def known_positions(sweep: Sweep) -> tuple[RigidTransform, str]:
    """Poses of a phantom sweep's frames and their source: the stored truth, or the tracker's, smoothed.

    A tracker's jitter is a good part of the distances wanted here. The probe moves more smoothly: a smoothing
    spline, its stiffness from generalised cross-validation, takes the jitter out.

    Raises
    ------
    InsufficientDataError
        If there is neither, or the tracker does not cover every frame.
    """
    if sweep.truth is not None:
        return sweep.truth, "truth"
    if sweep.tracker is None:
        raise InsufficientDataError(
            f"{sweep.name}: expected a phantom sweep with known positions (/truth or /tracker), got neither"
        )
    poses = sweep.tracker.world_from_image(sweep.frame_time_s)
    if len(poses) < 8:
        return poses, "tracker"
    first = poses[0]
    motion = (first.inv() * poses).as_matrix()
    values = np.hstack([motion[:, :3, 3], Rotation.from_matrix(motion[:, :3, :3]).as_rotvec()])
    smooth = np.stack(
        [make_smoothing_spline(sweep.frame_time_s, v)(sweep.frame_time_s) for v in values.T], axis=1
    )
    moved = RigidTransform.from_components(smooth[:, :3], Rotation.from_rotvec(smooth[:, 3:]))
    return first * moved, "tracker"


def phantom_pairs(sweep: Sweep, settings: CurveSettings | None = None) -> IntArray:
    """Choose frame pairs of a phantom sweep that are within the curves' reach, shape (m, 2).

    Raises
    ------
    InsufficientDataError
        If positions are not known, or no frames are near enough to each other.
    """
    s = settings or CurveSettings()
    pairs = _choose_pairs(_separations(known_positions(sweep)[0], sweep.grid.centre_mm), s)
    if not len(pairs):
        raise InsufficientDataError(
            f"{sweep.name}: expected phantom frames closer than {s.largest_mm:g} mm, got none"
        )
    return pairs


def phantom_samples(
    sweep: Sweep, patches: PatchGrid, table: CorrelationTable, pairs: IntArray
) -> PhantomSamples:
    """Set the correlations of matched phantom frames beside their known distances.

    Parameters
    ----------
    table : CorrelationTable
    pairs : ndarray, shape (m, 2)
        Those of the table that count.
    """
    poses, _ = known_positions(sweep)
    depth = patches.centre_mm[:, 1]
    rows, wanted = [], set(map(tuple, pairs.tolist()))
    for row, (first, second) in enumerate(zip(table.first.tolist(), table.second.tolist(), strict=True)):
        if (first, second) in wanted:
            offset, tilt = _patch_offsets(poses[first].inv() * poses[second], patches, table.motion[row])
            tilts = np.full(depth.size, tilt)
            rows.append(np.column_stack([depth, offset, tilts, table.correlation[row].astype(float)]))
    depths, offset, tilt, correlation = np.concatenate(rows).T
    return PhantomSamples(depths, offset, tilt, correlation, len(rows))


def _separations(poses: RigidTransform, centre_mm: FloatArray) -> FloatArray:
    """Elevational distance of each frame's centre from each other's plane, shape (n, n), mm."""
    centres = poses.apply(centre_mm)
    normals = poses.rotation.apply([0.0, 0.0, 1.0])
    return np.asarray(np.abs(np.einsum("ijk,ik->ij", centres[None] - centres[:, None], normals)))


def _choose_pairs(separation: FloatArray, settings: CurveSettings) -> IntArray:
    """Pairs within reach, thinned evenly over separation, shape (m, 2), first before second."""
    first, second = np.triu_indices(len(separation), 1)
    near = separation[first, second] <= settings.largest_mm
    pairs = np.column_stack([first[near], second[near]])
    if len(pairs) <= settings.pairs:
        return pairs
    order = np.argsort(separation[pairs[:, 0], pairs[:, 1]], kind="stable")
    kept = order[np.linspace(0, len(order) - 1, settings.pairs).astype(int)]
    return np.asarray(pairs[np.sort(kept)])


def _patch_offsets(
    first_from_second: RigidTransform, patches: PatchGrid, motion: InPlaneMotion
) -> tuple[FloatArray, float]:
    """Signed distance of each patch of the second frame from the first frame's plane, mm, and its tilt."""
    lateral = patches.centre_mm - [motion.x_mm, motion.y_mm]
    points = np.column_stack([lateral, np.zeros(len(lateral))])
    return np.asarray(first_from_second.apply(points)[:, 2]), float(
        first_from_second.rotation.as_matrix()[2, 1]
    )


def phantom_speckle(
    depth_mm: FloatArray, seen: Iterable[tuple[FloatArray, SpeckleSize]]
) -> SpeckleSize | None:
    """Mean speckle size of phantom sweeps at each depth of the curves; None if no depth has any.

    Parameters
    ----------
    depth_mm : ndarray, shape (r,)
    seen : iterable of (ndarray, SpeckleSize)
        Depths of a sweep's rows of patches, and the sizes there, NaN where they are not known.
    """
    some = list(seen)
    depth = np.concatenate([depths for depths, _ in some])
    sizes = []
    for name in ("lateral_mm", "axial_mm"):
        values = np.concatenate([getattr(size, name) for _, size in some])
        known = np.isfinite(values)
        if not known.any():
            return None
        rows, label = np.unique(np.round(depth[known], 6), return_inverse=True)
        sizes.append(np.interp(depth_mm, rows, np.bincount(label, values[known]) / np.bincount(label)))
    return SpeckleSize(*sizes)
