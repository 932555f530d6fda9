"""On which side of each other frames lie, where a sensor says otherwise than the images.

Distances have no sign. After a turn in the motion images may take a stretch for its mirror image; a tracker,
however it jitters, sees over such a stretch which way the probe went, and an accelerometer feels its ends.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.geometry import mirrored
from speckle3d.core.relative import RelativePoses
from speckle3d.correction.fused.images import ImageEvidence
from speckle3d.correction.fused.problem import Normal
from speckle3d.correction.fused.sensors import SensorEvidence

BEYOND_DOUBT = 12.0
"""Logarithm of the likelihood ratio from which a stretch is turned over: about five deviations."""
WILD = 3.0
"""Deviations beyond which a reading tells neither side."""
FAR_FRAMES = 10
"""Edges over so many more frames than most are between visits of one place."""
ROUNDS = 6
SETTLED = 1e-6


def on_sensed_sides(
    edges: RelativePoses, start: RigidTransform, tracker: SensorEvidence
) -> tuple[RelativePoses, RigidTransform]:
    """Edges and the images' poses with those stretches mirrored that a tracker sees go the other way.

    Parameters
    ----------
    start : RigidTransform, length n
        ``first_from_frame`` about the image's centre.
    """
    ratio, span, near = _ratios(edges, tracker, len(start)), edges.second - edges.first, _near(edges)
    across = np.zeros(len(start) + 1)
    np.add.at(across, edges.first[near], (ratio / span)[near])
    np.add.at(across, edges.second[near], -(ratio / span)[near])
    flip = _stretches(np.cumsum(across)[: len(start) - 1])
    # Visits of one place were found by the images' own path, and tell no more than their distance.
    return _turned_over(edges, start, flip, np.where(near, _mostly(edges, flip), ratio < -BEYOND_DOUBT))


def on_felt_sides(
    edges: RelativePoses, start: RigidTransform, flip: BoolArray
) -> tuple[RelativePoses, RigidTransform]:
    """Edges and the images' poses with those steps mirrored that are felt to go the other way.

    Parameters
    ----------
    start : RigidTransform, length n
        ``first_from_frame`` about the image's centre.
    flip : ndarray of bool, shape (n - 1,)
        From each frame to the next.
    """
    return _turned_over(edges, start, flip, _near(edges) & _mostly(edges, flip))


def _near(edges: RelativePoses) -> BoolArray:
    span = edges.second - edges.first
    return np.asarray(span <= np.median(span) + FAR_FRAMES)


def _mostly(edges: RelativePoses, flip: BoolArray) -> BoolArray:
    """Edges most of whose steps are turned over."""
    passed = np.concatenate([[0], np.cumsum(flip)])
    return np.asarray((passed[edges.second] - passed[edges.first]) > (edges.second - edges.first) / 2)


def _turned_over(
    edges: RelativePoses, start: RigidTransform, flip: BoolArray, turned: BoolArray
) -> tuple[RelativePoses, RigidTransform]:
    """Mirror some edges, and start from the steps of which some are mirrored."""
    if not turned.any():
        return edges, start
    turned_edges = _mirrored_where(edges, turned)
    step = start[:-1].inv() * start[1:]
    matrices = np.where(flip[:, None, None], mirrored(step).as_matrix(), step.as_matrix())
    chain = [np.eye(4)]
    for each in matrices:
        chain.append(chain[-1] @ each)
    return turned_edges, _solved(turned_edges, RigidTransform.from_matrix(np.array(chain)))


def _stretches(ratio: FloatArray) -> BoolArray:
    """Which steps are in stretches that are likelier mirrored, given each step's logarithm of the ratio.

    The best of all sequences of stretches, each of which costs `BEYOND_DOUBT` (Viterbi's algorithm).
    """
    change = BEYOND_DOUBT / 2
    score, came = np.array([0.0, -change]), np.zeros((ratio.size, 2), dtype=bool)
    for k, gain in enumerate(ratio):
        other = score[::-1] - change
        came[k] = other > score
        score = np.maximum(score, other) + np.array([gain, -gain]) / 2
    side = int(score[1] - change > score[0])
    flip = np.zeros(ratio.size, dtype=bool)
    for k in range(ratio.size - 1, -1, -1):
        flip[k] = side
        side = 1 - side if came[k, side] else side
    return flip


def _ratios(edges: RelativePoses, tracker: SensorEvidence, frames: int) -> FloatArray:
    """Logarithms of how much likelier each edge is than its mirror image, shape (e,); zero if not seen."""
    image = tracker.measured * tracker.centre_from_sensor.inv()
    nearest = tracker.before + (tracker.share > 0.5)
    seen, first = np.unique(nearest, return_index=True)
    row = np.full(frames, -1)
    row[seen] = first
    both = (row[edges.first] >= 0) & (row[edges.second] >= 0)
    a, b = row[edges.first[both]], row[edges.second[both]]
    lever = float(np.linalg.norm(tracker.centre_from_sensor.translation))
    jitter = float(np.hypot(tracker.jitter[1], lever * tracker.jitter[0]))
    sensed = (image[a].inv() * image[b]).translation[:, 2]
    z, variance = edges.poses.translation[both, 2], edges.covariance[both, 2, 2]
    ratio = np.zeros(len(edges))
    # Edges of one frame share its reading, so that each counts for less.
    shared = np.bincount(edges.second, minlength=frames)[edges.second[both]]
    sigma = np.sqrt(2.0 * jitter**2 + variance)
    off, other = (np.minimum(np.abs(sensed - side * z) / sigma, WILD) for side in (1.0, -1.0))
    ratio[both] = (other**2 - off**2) / 2.0 / np.maximum(shared, 1)
    return ratio


def _mirrored_where(edges: RelativePoses, turned: BoolArray) -> RelativePoses:
    other = edges.mirrored()
    matrices = np.where(turned[:, None, None], other.poses.as_matrix(), edges.poses.as_matrix())
    covariance = np.where(turned[:, None, None], other.covariance, edges.covariance)
    return replace(edges, poses=RigidTransform.from_matrix(matrices), covariance=covariance)


def _solved(edges: RelativePoses, start: RigidTransform) -> RigidTransform:
    """Poses by the edges alone."""
    poses = start
    for _ in range(ROUNDS):
        images = ImageEvidence(edges, poses, 1.0, np.ones(2), np.ones(6), 1.0)
        normal = Normal.of(images.alone(), 6 * (len(poses) - 1))
        step = -normal.factor().solve(normal.gradient).reshape(-1, 6)
        poses = poses * RigidTransform.from_exp_coords(np.concatenate([np.zeros((1, 6)), step]))
        if np.abs(step).max() < SETTLED:
            break
    return poses
