"""Errors of all frames' poses jointly, from the covariance of each and from what all have in common.

What the frame pairs scatter by is passed on from frame to frame: the later frame has the earlier one's error,
carried along as by a rigid body, and an error of its own on top. What all distances have wrong together moves
all frames at once.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.geometry import skew
from speckle3d.core.pose_errors import PoseErrors
from speckle3d.core.reconstruction import SharedErrors
from speckle3d.motion.uncertainty import changing_variance, common_factors

KNOTS = 40
"""Frames between which errors are interpolated: with six new variables each, some 10 MB for 300 frames."""
ROUNDING = 1e-6
"""Share of the largest error below which a component's own is rounding: errors carried into it would be
divided by next to nothing."""
_LEAST = 1e-12
"""Share of a variance below which a direction is as good as certain."""


def joint_errors(
    covariance: FloatArray,
    world_from_image: RigidTransform,
    centre_mm: FloatArray,
    shared: SharedErrors | None = None,
) -> PoseErrors:
    """Errors of all frames together whose covariances, frame by frame, are those given.

    Parameters
    ----------
    covariance : ndarray, shape (n, 6, 6)
        Of (x, y, z, tilt, yaw, roll) about the image's centre along the first frame's axes, mm and rad.
    world_from_image : RigidTransform, length n
    centre_mm : ndarray, shape (3,)
    shared : SharedErrors, optional
        Which part of `covariance` all frames have in common. Without it all of it is taken to have grown
        from frame to frame: never less for two frames of a sweep that goes one way, and the same for its
        whole length.
    """
    poses = world_from_image[0].inv() * world_from_image
    parts = []
    if shared is not None:
        common = common_factors(poses, centre_mm, shared)
        variance = changing_variance(poses, centre_mm, shared)
        covariance = covariance - np.einsum("mia,mib->iab", common, common)
        covariance = covariance - variance[:, :, None] * np.eye(6)
        parts = [common, walk_factors(variance)]
    parts.append(chain_factors(covariance, poses.apply(centre_mm)))
    factors = np.concatenate(parts)
    return PoseErrors(factors[np.abs(factors).max(axis=(1, 2)) > 0.0])


def walk_factors(variance: FloatArray) -> FloatArray:
    """Errors whose variances grow along the sweep, each component for itself, shape (m, n, 6).

    Parameters
    ----------
    variance : ndarray, shape (n, 6)
        Never decreasing.
    """
    knots = knot_frames(len(variance))
    factors = np.zeros((6, knots.size - 1, len(variance), 6))
    for component, own in enumerate(variance.T):
        grown = np.diff(own[knots])
        share = (own[None, :] - own[knots[:-1], None]) / np.where(grown > 0.0, grown, 1.0)[:, None]
        factors[component, ..., component] = np.sqrt(grown[:, None] * np.clip(share, 0.0, 1.0))
    return factors.reshape(-1, len(variance), 6)


def chain_factors(covariance: FloatArray, centres_mm: FloatArray) -> FloatArray:
    """Errors passed on from frame to frame whose covariances are those given, shape (m, n, 6).

    Parameters
    ----------
    covariance : ndarray, shape (n, 6, 6)
        What is not positive in it is left out.
    centres_mm : ndarray, shape (n, 3)
        Along the axes of `covariance`.
    """
    n = len(covariance)
    size = _sizes(covariance, centres_mm)
    target = _positive(covariance / np.outer(size, size))
    knots = knot_frames(n)
    reached = target[0] * np.outer(size, size)
    steps, injected = [_root(reached)], [0]
    for before, now in pairwise(knots):
        carry = carried(centres_mm[now] - centres_mm[before])
        brought = carry @ reached @ carry.T
        new = _positive((target[now] * np.outer(size, size) - brought) / np.outer(size, size))
        new *= np.outer(size, size)
        steps.append(_root(new))
        injected.append(int(now))
        reached = brought + new
    share = _shares(knots, n)
    factors = np.zeros((len(steps), 6, n, 6))
    for number, (frame, root) in enumerate(zip(injected, steps, strict=True)):
        carry = carried(centres_mm - centres_mm[frame])
        factors[number] = share[number, None, :, None] * np.einsum("iab,bm->mia", carry, root)
    return np.asarray(_with_covariance(factors.reshape(-1, n, 6) / size, target) * size)


def _sizes(covariance: FloatArray, centres_mm: FloatArray) -> FloatArray:
    """Largest standard deviation of each component, none less than `ROUNDING` of the largest, shape (6,).

    Angles are compared with displacements by what they displace over the whole sweep.
    """
    own = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2).max(axis=0), 1e-24))
    lever_mm = 1.0 + float(np.linalg.norm(centres_mm - centres_mm[0], axis=1).max())
    arm = np.array([1.0, 1.0, 1.0, lever_mm, lever_mm, lever_mm])
    return np.asarray(np.maximum(own, ROUNDING * float((own * arm).max()) / arm))


def turn_factors(
    sigma_rad: FloatArray,
    wander_s: float,
    time_s: FloatArray,
    world_from_image: RigidTransform,
    centre_mm: FloatArray,
) -> FloatArray:
    """Errors of poses whose steps are turned by a sensor that wanders, shape (m, n, 6).

    The first frame's error is none: against it the others are, and the path bends by the turn along it.

    Parameters
    ----------
    sigma_rad : ndarray, shape (3,)
        Standard deviation of the turn about each of the world's axes.
    wander_s : float
        Time in which it changes.
    """
    knots = knot_frames(len(time_s))
    apart = np.abs(time_s[knots][:, None] - time_s[knots])
    value, axes = np.linalg.eigh(np.exp(-apart / wander_s))
    root = axes * np.sqrt(np.maximum(value, 0.0))
    course = np.array([np.interp(time_s, time_s[knots], column) for column in root.T])
    course -= course[:, :1]
    from_world = world_from_image[0].rotation.inv()
    axes_mm = from_world.apply(np.eye(3)) * sigma_rad[:, None]
    turns = (course[None, :, :, None] * axes_mm[:, None, None, :]).reshape(-1, len(time_s), 3)
    steps = np.diff(from_world.apply(world_from_image.apply(centre_mm)), axis=0)
    factors = np.zeros((len(turns), len(time_s), 6))
    factors[:, 1:, :3] = np.cumsum(np.cross((turns[:, 1:] + turns[:, :-1]) / 2, steps), axis=1)
    factors[:, :, 3:] = turns
    return factors


def carried(shift_mm: FloatArray) -> FloatArray:
    """What a rigid body's error, (x, y, z, tilt, yaw, roll), is at points so far away, (..., 6, 6)."""
    matrix = np.zeros((*shift_mm.shape[:-1], 6, 6))
    matrix[...] = np.eye(6)
    matrix[..., :3, 3:] = -skew(shift_mm)
    return matrix


def knot_frames(frames: int) -> IntArray:
    """Frames between which errors are interpolated: the first, the last, and some in between."""
    return np.unique(np.linspace(0, frames - 1, min(frames, KNOTS + 1)).round().astype(np.int64))


def _shares(knots: IntArray, frames: int) -> FloatArray:
    """Share that frames have of the error new at each knot; its square rises from the knot before on."""
    share = np.ones((knots.size, frames))
    at = np.arange(frames)
    for number, (before, now) in enumerate(pairwise(knots), start=1):
        share[number] = np.sqrt(np.clip((at - before) / (now - before), 0.0, 1.0))
    return share


def _positive(covariance: FloatArray) -> FloatArray:
    """The nearest covariance without negative variances."""
    value, axes = np.linalg.eigh((covariance + np.swapaxes(covariance, -1, -2)) / 2)
    return np.asarray((axes * np.maximum(value, 0.0)[..., None, :]) @ np.swapaxes(axes, -1, -2))


def _root(covariance: FloatArray) -> FloatArray:
    """A matrix whose product with its transpose is `covariance`, shape (6, 6)."""
    size = np.sqrt(np.maximum(np.diagonal(covariance), 1e-24))
    value, axes = np.linalg.eigh(covariance / np.outer(size, size))
    return np.asarray(size[:, None] * axes * np.sqrt(np.maximum(value, 0.0)))


def _with_covariance(factors: FloatArray, target: FloatArray) -> FloatArray:
    """Factors whose covariance is `target` in every frame, changed as little as that allows.

    Between knots, after a return to what was seen before and where pairs far apart are tied, the errors
    passed on have another covariance than the frames.

    References
    ----------
    .. [1] I. Olkin and F. Pukelsheim, "The distance between two random vectors with given dispersion
       matrices", Linear Algebra and its Applications 48, 1982.
    """
    least = _LEAST * np.eye(6)
    now = np.einsum("mia,mib->iab", factors, factors) + least
    root = _power(now, 0.5)
    back = _power(now, -0.5)
    change = back @ _power(root @ (target + least) @ root, 0.5) @ back
    return np.asarray(np.einsum("iab,mib->mia", change, factors))


def _power(matrices: FloatArray, exponent: float) -> FloatArray:
    value, axes = np.linalg.eigh((matrices + np.swapaxes(matrices, -1, -2)) / 2)
    raised = np.maximum(value, _LEAST**2) ** exponent
    return np.asarray((axes * raised[..., None, :]) @ np.swapaxes(axes, -1, -2))
