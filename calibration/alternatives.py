"""Discrete ambiguities of a calibration: other answers, far away, that may explain the images as well.

Where a motion is missing, an image turned by half about one of its axes shows nearly the same: the lines of a
plane that is always equally deep do not tell the image from its in-plane mirror. Turned about its y axis, an
image is mirrored left to right (its column pitch negative), about its x axis top to bottom. Each is refined
to the end from the answer; the answer is the one of least cost, and the next is kept as its rival.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.chain import PROBE, Chain, ChainSolution, ImagePoints, Phantom, PixelPrior, Rival
from calibration.solver import OUTLIER_SIGMA, SOME_FRAMES, agreed, residuals_of, sigma_of, solve_chain
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.leastsquares import autocorrelation_time

_CUT = 3.0
"""Residuals beyond so many standard deviations count as much as one there: wrong points have no say."""
_APART_RAD, _APART = np.deg2rad(5.0), 0.1
"""Two chains are two answers where the images are turned by as much, or apart by this share of their size."""
_CLEAR = 100.0
"""Evidence on some frames above which a rival is not looked at on all of them."""


@dataclass(frozen=True)
class _Problem:
    """What is solved, from whichever start."""

    phantom: Phantom
    free: tuple[str, ...]
    outlier_sigma: float
    prior: PixelPrior | None

    def settled(self, points: ImagePoints, start: Chain) -> Chain | None:
        """Where iterations from a start end; None if most points contradict it there."""
        try:
            return agreed(points, self.phantom, start, self.free, self.outlier_sigma, self.prior)[0]
        except InsufficientDataError:
            return None

    def costs(self, points: ImagePoints, chains: Sequence[Chain]) -> FloatArray:
        """Sums of squared residuals, each cut off, in the unit of the least one's mean."""
        residuals = [residuals_of(points, self.phantom, chain) for chain in chains]
        if self.phantom.seen_as == "line":
            # Lines err by rows: an image that shrinks to nothing leaves no residual in millimetres.
            residuals = [one / chain.pixel_mm[1] for one, chain in zip(residuals, chains, strict=True)]
        cut = _CUT * min(sigma_of(one) for one in residuals)
        sums = np.array([float(np.sum(np.minimum(one**2, cut**2))) for one in residuals])
        least = max(float(sums.min()), np.finfo(float).tiny)
        best = residuals[int(np.argmin(sums))]
        independent = best.size / together(np.clip(best, -cut, cut), points.frame)
        known = [0.0 if self.prior is None else np.sum(self.prior.deviation(c.pixel_mm) ** 2) for c in chains]
        return np.asarray(independent * sums / least + np.array(known))


def best_solution(
    points: ImagePoints,
    phantom: Phantom,
    starts: Sequence[Chain],
    probe: tuple[str, ...] = PROBE,
    outlier_sigma: float = OUTLIER_SIGMA,
    prior: PixelPrior | None = None,
) -> ChainSolution:
    """Solve from several starts and their discrete alternatives; the best solution, and its rival.

    Parameters
    ----------
    starts : sequence of Chain
        At least one.

    Raises
    ------
    InsufficientDataError
        See `solve_chain`.
    """
    free = (*probe, *phantom.determined)
    problem = _Problem(phantom, free, outlier_sigma, prior if "s_x" in free else None)
    few = points.of_some_frames(SOME_FRAMES)
    found = [chain for start in starts if (chain := problem.settled(few, start)) is not None]
    if not found:
        return solve_chain(points, phantom, starts[0], probe, outlier_sigma, prior)
    best = found[int(np.argmin(problem.costs(few, found)))]
    turned = [problem.settled(few, start) for start in half_turns(best, few, phantom)]
    found += [chain for chain in turned if chain is not None]
    costs = problem.costs(few, found)
    best = found[int(np.argmin(costs))]
    others = [k for k, chain in enumerate(found) if apart(best, chain, points, phantom)]
    solution = solve_chain(points, phantom, best, probe, outlier_sigma, prior)
    if not others:
        return solution
    next_ = min(others, key=lambda k: float(costs[k]))
    evidence = float(costs[next_] - costs.min())
    rival: Chain | None = found[next_]
    if evidence < _CLEAR and len(few) < len(points) and rival is not None:
        rival = problem.settled(points, rival)
    if rival is None or not apart(solution.chain, rival, points, phantom):
        return solution
    used = solution.points_used
    ours, theirs = problem.costs(used, [solution.chain, rival])
    if theirs < ours:
        other = solve_chain(points, phantom, rival, probe, outlier_sigma, prior)
        return replace(other, rival=Rival(solution.chain, float(ours - theirs)))
    return replace(solution, rival=Rival(rival, float(theirs - ours)))


def half_turns(chain: Chain, points: ImagePoints, phantom: Phantom) -> list[Chain]:
    """The image turned by half about each of its axes through the middle of what it shows.

    About its z axis not where directions alone are known: they stay exactly as they are.
    """
    middle = np.append(np.median(points.pixels, axis=0) * chain.pixel_mm, 0.0)
    if phantom.seen_as == "direction":
        middle[:] = 0.0
    axes = np.eye(3)[: 2 if phantom.seen_as == "direction" else 3]
    turns = [Rotation.from_rotvec(np.pi * axis) for axis in axes]
    steps = [RigidTransform.from_components(middle - turn.apply(middle), turn) for turn in turns]
    return [replace(chain, sensor_from_image=chain.sensor_from_image * step) for step in steps]


def apart(one: Chain, other: Chain, points: ImagePoints, phantom: Phantom) -> bool:
    """Whether two chains are two answers, not one."""
    here, there = (chain.sensor_from_image.as_matrix() for chain in (one, other))
    step = here[:3, :3].T @ there[:3, :3]
    angle = _angle(step)
    if phantom.seen_as == "direction":
        # Half a turn about the image's z axis is the same to directions.
        return bool(min(angle, _angle(step * [-1.0, -1.0, 1.0])) > _APART_RAD)
    right_down = points.pixels.max(axis=0)
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * right_down
    ours, theirs = (
        (corners * chain.pixel_mm) @ matrix[:3, :2].T + matrix[:3, 3]
        for chain, matrix in ((one, here), (other, there))
    )
    far = float(np.linalg.norm(ours - theirs, axis=1).max())
    return bool(angle > _APART_RAD or far > _APART * np.linalg.norm(right_down * one.pixel_mm))


def _angle(rotation: FloatArray) -> float:
    """Angle of a rotation matrix, shape (3, 3)."""
    return float(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0)))


def together(residuals: FloatArray, frame: IntArray) -> float:
    """How many residuals count as one, for a sensor's error moves all of a frame and wanders slowly.

    Parameters
    ----------
    residuals : ndarray, shape (n, r)
    frame : ndarray of int, shape (n,)
    """
    index = np.unique(frame, return_inverse=True)[1]
    sums = np.stack([np.bincount(index, column) for column in residuals.T])
    energy, all_ = float(np.sum(sums**2)), float(np.sum(residuals**2))
    if all_ <= 0:
        return 1.0
    times = [autocorrelation_time(one) * float(one @ one) for one in sums]
    return max(1.0, sum(times) / all_) if energy > 0 else 1.0
