"""Correlations between phantom frames at known positions, for the decorrelation curves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.sweep import Sweep
from speckle3d.matching.inplane import InPlaneMotion
from speckle3d.matching.matcher import FrameMatcher, ReadyFrame, compose, inverse
from speckle3d.motion.decorrelation import CurveSettings, PhantomSamples


def known_positions(sweep: Sweep) -> tuple[RigidTransform, str]:
    """Poses of a phantom sweep's frames: the truth if stored, else the tracker's, smoothed over time.

    A tracker's jitter is a good part of the distances wanted here, and the probe's motion is smoother than
    it: a smoothing spline whose stiffness comes from generalised cross-validation separates them.

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


def phantom_samples(
    sweep: Sweep,
    matcher: FrameMatcher,
    settings: CurveSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> PhantomSamples:
    """Correlate frame pairs of one phantom sweep that are closer than the curves' reach.

    Frames are read once, in order, and kept only while later ones are within reach.
    """
    s = settings or CurveSettings()
    poses, _ = known_positions(sweep)
    wanted = _choose_pairs(_separations(poses, sweep.grid.centre_mm), s)
    kept: dict[int, ReadyFrame] = {}
    motion = {0: InPlaneMotion()}
    rows: list[FloatArray] = []
    for frame in range(len(sweep)):
        kept[frame] = matcher.prepare(matcher.echo(sweep.frames[frame]))
        if frame:
            start = matcher.search(kept[frame - 1], kept[frame])
            step = matcher.match(kept[frame - 1], kept[frame], start).motion
            motion[frame] = compose(motion[frame - 1], step)
        for first in wanted[wanted[:, 1] == frame, 0]:
            start = compose(inverse(motion[first]), motion[frame])
            match = matcher.match(kept[first], kept[frame], start)
            offset, tilt = _patch_offsets(poses[first].inv() * poses[frame], matcher, match.motion)
            depth = matcher.patches.centre_mm[:, 1]
            rows.append(np.column_stack([depth, offset, np.full(depth.size, tilt), match.correlation]))
        needed = wanted[wanted[:, 1] > frame, 0]
        kept = {k: v for k, v in kept.items() if k == frame or k in needed}
        if progress:
            progress(frame + 1, len(sweep))
    if not rows:
        raise InsufficientDataError(
            f"{sweep.name}: expected phantom frames closer than {s.largest_mm:g} mm, got none"
        )
    table = np.concatenate(rows)
    depth, offset, tilt, correlation = table.T
    return PhantomSamples(depth, offset, tilt, correlation, len(rows))


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
    first_from_second: RigidTransform, matcher: FrameMatcher, motion: InPlaneMotion
) -> tuple[FloatArray, float]:
    """Signed distance of each patch of the second frame from the first frame's plane, mm, and its tilt."""
    lateral = matcher.patches.centre_mm - [motion.x_mm, motion.y_mm]
    points = np.column_stack([lateral, np.zeros(len(lateral))])
    return np.asarray(first_from_second.apply(points)[:, 2]), float(
        first_from_second.rotation.as_matrix()[2, 1]
    )
