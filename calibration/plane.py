"""The plane module: from pixels to a phantom, the solver that all phantoms share, and the plane itself.

A pixel (u, v) of size (s_x, s_y) is carried by ``target_from_world * world_from_sensor * sensor_from_image``
into the phantom's frame, where the phantom says which components must vanish: for a plane the height above
it, [1]_ equation 8; `wires` and `orientation` bring their own. Fourteen parameters in all; those that a
phantom leaves undetermined are held.

Parameters are refined as small displacements in the image's own frame and in the phantom's: there no angle
is near a singularity, wherever the sensor is mounted, and all are of one scale.

References
----------
.. [1] R. W. Prager et al., "Automatic calibration for 3-D free-hand ultrasound", CUED/F-INFENG/TR 303, 1997.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.motion import OBLONG, Adequacy, judge, require_adequate
from calibration.noise import fit_noise
from calibration.points import (
    ANGLES,
    CHAIN,
    POSE,
    PROBE,
    SCALES,
    SOME_FRAMES,
    ImagePoints,
    SeenAs,
    as_directions,
    columns_of,
)
from calibration.robust import autocorrelation_time, robust_linear
from calibration.settings import OUTLIER_SIGMA, PlaneFit
from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.geometry import nearest_rotation, roll_yaw_tilt, skew
from speckle3d.core.leastsquares import condition_number, robust_sigma
from speckle3d.core.shown import shown

_FEWEST_LINES = 6
"""Two equations each: the fewest for eleven unknowns."""
_NORMALS = 30
"""About 26 degrees apart: refinement converges from further away."""
_MOST_STEPS = 100
_TOLERANCE = 1e-12
"""Relative decrease of the sum of squares that a last step promises."""
_REFINED, _KEPT, _ANGLE_FRAMES, _ROUNDS = 6, 3, 30, 4
"""Normals whose angles are refined, from so many frames with so many reweightings, and those that go on."""
_HOPELESS, _TINY = 3.0, 1e-12
"""Ends whose mean absolute residual is as many times the least are not looked at again."""
_ROUGHLY = 1e-3
_NEARLY = 0.1
"""Residuals above this share of the median count by their absolute value."""
_REWEIGHTINGS = 8
_SMALLEST_SIGMA = 1e-7
"""Residuals of exact data are rounding; nothing in them is an outlier."""
_FREE_ROUNDS, _MOST_ROUNDS = 5, 30
"""After so many rounds frames may be left out but not taken back, so that the rounds end."""
_RUNAWAY, _RESIZED = 2.0, 0.1
"""A fit with wandering errors that doubles the residuals or changes pixel sizes by a tenth has run away along
what the motion leaves open."""
_CUT = 3.0
"""Residuals count up to so many standard deviations where answers are compared."""
_APART_RAD, _APART = np.deg2rad(5.0), 0.1
"""Two answers differ by this angle, or by this share of the image's size."""
_CONTRADICTS = 3.0
"""Standard errors by which lines must move a pixel size given for it to be doubted."""


# 1. The chain: image -> sensor -> world -> phantom (TR 303, section 3)


@dataclass(frozen=True)
class Chain:
    """An estimate of all fourteen parameters.

    Attributes
    ----------
    pixel_mm : ndarray, shape (2,)
        Column pitch and row spacing.
    """

    pixel_mm: FloatArray
    sensor_from_image: RigidTransform
    target_from_world: RigidTransform

    @cached_property
    def matrices(self) -> tuple[FloatArray, FloatArray]:
        """Sensor from image and target from world, shape (4, 4) each."""
        return self.sensor_from_image.as_matrix(), self.target_from_world.as_matrix()

    def target_from_image(self, points: ImagePoints) -> RigidTransform:
        """Pose of the image of each point in the phantom's frame."""
        probe, target = self.matrices
        return RigidTransform(target @ points.world_from_sensor.as_matrix() @ probe, normalize=False)

    def parameters(self) -> FloatArray:
        """The parameters as published, in the order of `CHAIN`: x-y-z fixed angles, abs(beta) <= pi / 2."""
        parts = [self.pixel_mm]
        for pose in (self.sensor_from_image, self.target_from_world):
            parts += [np.asarray(pose.translation), roll_yaw_tilt(pose.rotation)]
        return np.concatenate(parts)

    def displaced(self, step: FloatArray) -> Chain:
        """Displace the image in its frame and the world in the phantom's, `step` in the order of `CHAIN`.

        A pixel size that becomes negative is made positive by turning the image by half about its other axis,
        which is the same calibration; TR 303, appendix C, does so with angles.
        """
        size = self.pixel_mm + step[:2]
        sign = np.where(size < 0, -1.0, 1.0)
        moved, shifted = np.eye(4), np.eye(4)
        moved[:3, :3] = Rotation.from_rotvec(step[7:4:-1]).as_matrix() * [*sign, sign.prod()]
        moved[:3, 3] = step[2:5]
        shifted[:3, :3], shifted[:3, 3] = Rotation.from_rotvec(step[13:10:-1]).as_matrix(), step[8:11]
        probe, target = self.matrices
        return Chain(
            np.abs(size),
            RigidTransform(probe @ moved, normalize=False),
            RigidTransform(shifted @ target, normalize=False),
        )


class Phantom(Protocol):
    """What must vanish in the phantom's frame."""

    @property
    def seen_as(self) -> SeenAs:
        """What the points are: the two ends of a line, the direction of one, or a dot."""

    @property
    def determined(self) -> tuple[str, ...]:
        """Those of `TARGET` that images of the phantom determine."""

    def vanishing(self, points: ImagePoints) -> tuple[FloatArray, FloatArray]:
        """Rows, shape (n, r, 3), and offsets, (n, r): ``rows @ position - offsets`` is the residual, mm."""


@dataclass(frozen=True)
class Plane:
    """A plane at z = 0 of its own frame: one equation for each point (TR 303, equation 8)."""

    determined: tuple[str, ...] = ("z_c", "beta_c", "gamma_c")
    seen_as: SeenAs = "line"

    def vanishing(self, points: ImagePoints) -> tuple[FloatArray, FloatArray]:
        """Height above the plane."""
        n = len(points)
        return np.broadcast_to(np.array([[0.0, 0.0, 1.0]]), (n, 1, 3)), np.zeros((n, 1))


def line_directions(level: bool = False) -> Plane:
    """A plane of which line directions alone are used, wherever it is (TR 303, appendix A; Housden 2008).

    `ImagePoints.pixels` then holds directions (`as_directions`), and the poses have no translation: what
    vanishes is the sine of the angle between line and plane. A level one's normal is the world's z axis.
    """
    return Plane(() if level else ("beta_c", "gamma_c"), "direction")


# 2. Residuals and their derivatives


@dataclass(frozen=True)
class Equations:
    """What must vanish for each point of a phantom.

    Attributes
    ----------
    rows, offsets : ndarray, shapes (n, r, 3) and (n, r)
        See `Phantom.vanishing`.
    weights : ndarray, shape (n, r), optional
        Factor on each equation.
    """

    points: ImagePoints
    rows: FloatArray
    offsets: FloatArray
    weights: FloatArray | None = None

    @classmethod
    def of(cls, points: ImagePoints, phantom: Phantom) -> Equations:
        """Those of a phantom's points."""
        return cls(points, *phantom.vanishing(points))

    def __getitem__(self, chosen: BoolArray) -> Equations:
        return Equations(self.points[chosen], self.rows[chosen], self.offsets[chosen])

    def at(self, chain: Chain) -> tuple[FloatArray, FloatArray]:
        """Residuals, (n, r), and derivatives by the small displacements of `Chain.displaced`, (n, r, 14)."""
        probe, target = (matrix[:3, :3] for matrix in chain.matrices)
        place, (u, v) = self._places(chain), self.points.pixels.T[..., None]
        x, y = u * chain.pixel_mm[0], v * chain.pixel_mm[1]
        in_world = (self.rows.reshape(-1, 3) @ target).reshape(self.rows.shape)
        in_sensor = np.einsum("nri,nij->nrj", in_world, self.points.turns)
        # The rows in the image's axes.
        across, down, out = (in_sensor.reshape(-1, 3) @ probe).T.reshape(3, *self.offsets.shape)
        (a, b, c), (p, q, r) = np.moveaxis(self.rows, 2, 0), place.T[..., None]
        slopes = np.empty((len(CHAIN), *self.offsets.shape))
        slopes[0], slopes[1] = across * u, down * v
        slopes[2], slopes[3], slopes[4] = across, down, out
        slopes[5], slopes[6], slopes[7] = x * down - y * across, -x * out, y * out
        slopes[8], slopes[9], slopes[10] = a, b, c
        slopes[11], slopes[12], slopes[13] = p * b - q * a, r * a - p * c, q * c - r * b
        values = p * a + q * b + r * c - self.offsets
        if self.weights is not None:
            values, slopes = values * self.weights, slopes * self.weights
        return values, np.moveaxis(slopes, 0, 2)

    def residuals(self, chain: Chain) -> FloatArray:
        """What does not vanish, shape (n, r)."""
        return np.asarray(np.einsum("nri,ni->nr", self.rows, self._places(chain)) - self.offsets)

    def _places(self, chain: Chain) -> FloatArray:
        """Where the points are in the phantom's frame, mm, shape (n, 3)."""
        probe, target = chain.matrices
        in_sensor = (self.points.pixels * chain.pixel_mm) @ probe[:3, :2].T + probe[:3, 3]
        in_world = np.einsum("nij,nj->ni", self.points.turns, in_sensor) + self.points.shifts_mm
        return np.asarray(in_world @ target[:3, :3].T + target[:3, 3])


@dataclass(frozen=True)
class PixelPrior:
    """What is known of the pixel size before anything is measured: `error` is a share of `pixel_mm`."""

    pixel_mm: FloatArray
    error: float

    def deviation(self, pixel_mm: FloatArray) -> FloatArray:
        """Deviation of other sizes, in standard errors, shape (2,)."""
        return np.asarray((pixel_mm / self.pixel_mm - 1.0) / self.error)


# 3. The solver


def least_squares(
    equations: Equations,
    start: Chain,
    free: Sequence[str],
    prior: PixelPrior | None = None,
    sigma: float = 1.0,
    tolerance: float = _TOLERANCE,
) -> Chain:
    """Minimise the sum of squares by Levenberg's and Marquardt's steps, in frames that move along.

    Parameters
    ----------
    prior : PixelPrior, optional
        Counts as two further residuals of standard deviation `sigma`.
    tolerance : float
        Relative decrease of the sum of squares below which a step is the last.

    Raises
    ------
    InvalidInputError
        If there are fewer residuals than parameters, or some are not finite.
    """
    columns = columns_of(free)

    def at(chain: Chain) -> tuple[FloatArray, FloatArray, float]:
        values, slopes = equations.at(chain)
        r, j = values.ravel(), slopes.reshape(values.size, -1)[:, columns]
        if prior is not None:
            slope = sigma / (prior.error * prior.pixel_mm[:, None])
            more = (np.array(columns) == np.arange(2)[:, None]) * slope
            r, j = np.append(r, sigma * prior.deviation(chain.pixel_mm)), np.vstack([j, more])
        return j.T @ j, j.T @ r, float(r @ r)

    chain, (normal, pull, cost) = start, at(start)
    count = equations.offsets.size + (2 if prior else 0)
    if count < len(columns):
        raise InvalidInputError(f"expected at least {len(columns)} residuals, got {count}")
    if not np.isfinite(cost):
        raise InvalidInputError("expected finite residuals at the starting point, got some that are not")
    damping, step = 1e-6, np.zeros(len(CHAIN))
    for _ in range(_MOST_STEPS):
        scale = np.sqrt(np.diag(normal))
        scale = np.where(scale > 0, scale, 1.0)
        scaled = normal / np.outer(scale, scale) + damping * np.eye(len(scale))
        moved = np.linalg.solve(scaled, pull / scale) / scale
        step[columns] = -moved
        moved_chain = chain.displaced(step)
        trial = at(moved_chain)
        promised = float(moved @ pull)
        if trial[2] <= cost:
            chain, (normal, pull, cost), damping = moved_chain, trial, max(damping / 10.0, 1e-12)
        else:
            damping = max(10.0 * damping, 1e-6)
        if promised <= tolerance * cost + count * np.finfo(float).eps ** 2 or damping > 1e6:
            break
    return chain


def absolute_weights(sizes: FloatArray, axis: int | None = None) -> FloatArray:
    """Weights by which most residuals count by their absolute value: Huber's, with a tenth of the median."""
    return np.asarray(1.0 / np.maximum(sizes, _NEARLY * np.median(sizes, axis, keepdims=True) + _TINY))


def nearly_absolute(
    equations: Equations, start: Chain, free: Sequence[str], rounds: int = _REWEIGHTINGS
) -> Chain:
    """Nearly least absolute residuals, by reweighting, so that wrong frames pull little."""
    chain, before = start, np.inf
    for _ in range(rounds):
        size = np.abs(equations.residuals(chain))
        if size.mean() > 0.99 * before:
            break
        before = size.mean()
        weights = np.sqrt(absolute_weights(size))
        chain = least_squares(replace(equations, weights=weights), chain, free, tolerance=_ROUGHLY)
    return chain


def sigma_of(residuals: FloatArray) -> float:
    """Robust standard deviation of residuals, not less than rounding."""
    return robust_sigma(residuals, _SMALLEST_SIGMA)


@shown
@dataclass(frozen=True)
class Solution:
    """A calibration as the solver leaves it: the chain, its certainty, and the frames it is made from.

    Attributes
    ----------
    free : tuple of str, length p
        The parameters estimated, among `CHAIN`.
    covariance : ndarray, shape (p, p)
        Of the free parameters: small displacements in the image's frame and in the phantom's.
    points : ImagePoints
        All that were given.
    used : ndarray of bool, shape (n,)
    residuals : ndarray, shape (n, r)
        Of all points, mm (sines of angles for directions).
    sigma : float
        Robust standard deviation of the residuals of the points used.
    evidence : float
        By how much the sum of squared residuals of another answer, far away, to which a discrete ambiguity
        leads, exceeds the solution's, in variances of an independent one.
    assumed : str
        What no image tells, and was taken for granted.
    """

    chain: Chain
    phantom: Phantom
    free: tuple[str, ...]
    covariance: FloatArray
    points: ImagePoints
    used: BoolArray
    residuals: FloatArray
    sigma: float
    prior: PixelPrior | None = None
    evidence: float = np.inf
    assumed: str = ""

    @property
    def angular(self) -> bool:
        """Whether only directions are known: residuals are sines of angles, and nothing has a length."""
        return self.phantom.seen_as == "direction"

    @cached_property
    def jacobian(self) -> FloatArray:
        """Derivatives of the residuals used by small displacements, shape (n r, p)."""
        _, slopes = Equations.of(self.points_used, self.phantom).at(self.chain)
        return slopes.reshape(-1, len(CHAIN))[:, columns_of(self.free)]

    @property
    def condition_number(self) -> float:
        """Of the derivatives, columns scaled to one length."""
        return condition_number(self.jacobian)

    @property
    def corners_moved(self) -> FloatArray:
        """Derivatives of the image's corners, mm, by the displacements of `CHAIN`, shape (4, 3, 14).

        The image is taken to reach as far as points are in it.
        """
        right, bottom = self.points_used.pixels.max(axis=0)
        corners = np.array([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]])
        moved = np.zeros((4, 3, len(CHAIN)))
        moved[:, 0, 0], moved[:, 1, 1] = corners.T
        moved[:, :, 2:5] = np.eye(3)
        moved[:, :, 7:4:-1] = -skew(np.column_stack([corners * self.chain.pixel_mm, np.zeros(4)]))
        return moved

    @cached_property
    def adequacy(self) -> Adequacy:
        """Whether the motion was sufficient, and what is missing."""
        return judge(self)

    @cached_property
    def points_used(self) -> ImagePoints:
        """The points that the solution is made from."""
        return self.points[self.used]

    @property
    def rms(self) -> float:
        """Root mean square residual of the points used."""
        return float(np.sqrt(np.mean(self.residuals[self.used] ** 2)))

    @cached_property
    def full_covariance(self) -> FloatArray:
        """Covariance of all of `CHAIN`, zero for parameters held, shape (14, 14)."""
        full, columns = np.zeros((len(CHAIN), len(CHAIN))), columns_of(self.free)
        full[np.ix_(columns, columns)] = self.covariance
        return full

    def image_covariance(self, names: Sequence[str]) -> FloatArray:
        """Covariance of some of the parameters, zero for those held."""
        columns = columns_of(names)
        return self.full_covariance[np.ix_(columns, columns)]


@dataclass(frozen=True)
class Problem:
    """What is solved, from whichever start.

    Parameters
    ----------
    phantom : Phantom
    probe : tuple of str
        Which of `PROBE` to estimate, besides all that the phantom determines.
    outlier_sigma : float
        Frames whose largest residual exceeds so many robust standard deviations are left out.
    prior : PixelPrior, optional
        Counts where the pixel size is estimated.
    """

    phantom: Phantom
    probe: tuple[str, ...] = PROBE
    outlier_sigma: float = OUTLIER_SIGMA
    prior: PixelPrior | None = None

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters estimated."""
        return (*self.probe, *self.phantom.determined)

    def solve(self, points: ImagePoints, start: Chain) -> Solution:
        """Refine a start until residuals are least, leaving out frames that contradict the others.

        Raises
        ------
        InsufficientDataError
            If there are too few points, or fewer than half of the frames agree.
        """
        chain, used = self.agreed(points, start)
        equations, free = Equations.of(points, self.phantom), self.free
        least = sigma_of(equations[used].residuals(chain))
        settled, _, covariance = fit_noise(equations[used], chain, free, self.phantom.seen_as, self.prior)
        resized = np.abs(np.log(settled.pixel_mm / chain.pixel_mm)).max()
        if sigma_of(equations[used].residuals(settled)) < _RUNAWAY * least and resized < _RESIZED:
            chain = settled
        if self.phantom.determined:
            # Where the phantom is, as the readings say on average: what wanders is not in its place.
            chain = least_squares(equations[used], chain, self.phantom.determined)
        residuals = equations.residuals(chain)
        sigma = sigma_of(residuals[used])
        return Solution(chain, self.phantom, free, covariance, points, used, residuals, sigma, self.prior)

    def agreed(self, points: ImagePoints, start: Chain) -> tuple[Chain, BoolArray]:
        """Least squares of the frames that do not contradict the others, and which points those are."""
        equations = Equations.of(points, self.phantom)
        # Pixel sizes that are known somewhat are held while wrong frames still pull.
        first = [name for name in self.free if self.prior is None or name not in SCALES]
        chain = nearly_absolute(equations, start, first)
        residuals = equations.residuals(chain)
        used = _within(residuals, points.frame, self.outlier_sigma * sigma_of(residuals))
        for number in range(_MOST_ROUNDS):
            frames, agreeing = len(points.frames), len(np.unique(points.frame[used]))
            if 2 * agreeing <= frames:
                raise InsufficientDataError(
                    f"expected most frames to agree on one calibration, got {agreeing} of {frames}: do the "
                    "images and the sensor readings belong together, and is the phantom the one named?"
                )
            sigma = sigma_of(residuals[used])
            chain = least_squares(equations[used], chain, self.free, self.prior, sigma)
            residuals = equations.residuals(chain)
            now = _within(residuals, points.frame, self.outlier_sigma * sigma_of(residuals[used]))
            if number >= _FREE_ROUNDS:
                now &= used
            if (now == used).all():
                break
            used = now
        return chain, used

    def best(self, points: ImagePoints, starts: Sequence[Chain]) -> Solution:
        """Solve from several starts and their discrete alternatives; the best solution, with its rival.

        Where a motion is missing, an image turned by half about one of its axes shows nearly the same: the
        lines of a plane that is always equally deep do not tell the image from its in-plane mirror.
        """
        few = points.of_some_frames(SOME_FRAMES)
        chains = self._ends(few, starts)
        if not chains:
            return self.solve(points, starts[0])
        best = chains[int(np.argmin(self._costs(few, chains)))]
        chains += self._ends(few, half_turns(best, few, self.phantom))
        costs = self._costs(few, chains)
        best = chains[int(np.argmin(costs))]
        solution = self.solve(points, best)
        others = [k for k, chain in enumerate(chains) if apart(best, chain, few, self.phantom)]
        nearest = [chains[min(others, key=lambda k: float(costs[k]))]] if others else []
        for rival in self._ends(points, nearest):
            if apart(solution.chain, rival, points, self.phantom):
                ours, theirs = self._costs(solution.points_used, [solution.chain, rival])
                if theirs < ours:
                    solution = self.solve(points, rival)
                return replace(solution, evidence=abs(float(theirs - ours)))
        return solution

    def _ends(self, points: ImagePoints, starts: Sequence[Chain]) -> list[Chain]:
        """Where iterations from each start end, unless most points contradict it there."""
        ends = []
        for start in starts:
            with suppress(InsufficientDataError):
                ends.append(self.agreed(points, start)[0])
        return ends

    def _costs(self, points: ImagePoints, chains: Sequence[Chain]) -> FloatArray:
        """Sums of squared residuals, each cut off, in the variance of an independent one at the least sum."""
        equations = Equations.of(points, self.phantom)
        lines = self.phantom.seen_as == "line"
        residuals = [equations.residuals(one) / (one.pixel_mm[1] if lines else 1.0) for one in chains]
        cut = _CUT * min(sigma_of(one) for one in residuals)
        sums = np.array([float(np.sum(np.minimum(one**2, cut**2))) for one in residuals])
        best = np.clip(residuals[int(np.argmin(sums))], -cut, cut)
        independent = best.size / together(best, points.frame)
        sums *= independent / max(float(sums.min()), _SMALLEST_SIGMA**2)
        if self.prior is not None:
            sums += [np.sum(self.prior.deviation(one.pixel_mm) ** 2) for one in chains]
        return sums


def _within(residuals: FloatArray, frame: IntArray, limit: float) -> BoolArray:
    """Points of the frames none of whose residuals exceeds `limit`."""
    return ~np.isin(frame, frame[(np.abs(residuals) > limit).any(axis=1)])


def together(residuals: FloatArray, frame: IntArray) -> float:
    """How many residuals, shape (n, r), count as one: a sensor's error moves all of a frame, and wanders."""
    index = np.unique(frame, return_inverse=True)[1]
    sums = np.stack([np.bincount(index, column) for column in residuals.T])
    whole = float(np.sum(residuals**2))
    times = [autocorrelation_time(one) * float(one @ one) for one in sums]
    return max(1.0, sum(times) / whole) if whole > 0 else 1.0


def half_turns(chain: Chain, points: ImagePoints, phantom: Phantom) -> list[Chain]:
    """The image turned by half about each of its axes through the middle of what it shows.

    About its z axis not where directions alone are known: they stay exactly as they are.
    """
    directions = phantom.seen_as == "direction"
    middle = np.append(np.median(points.pixels, axis=0) * chain.pixel_mm, 0.0) * (not directions)
    turns = [Rotation.from_rotvec(np.pi * axis) for axis in np.eye(3)[: 2 if directions else 3]]
    steps = [RigidTransform.from_components(middle - turn.apply(middle), turn) for turn in turns]
    return [replace(chain, sensor_from_image=chain.sensor_from_image * step) for step in steps]


def apart(one: Chain, other: Chain, points: ImagePoints, phantom: Phantom) -> bool:
    """Whether two chains are two answers, not one."""
    step = (one.sensor_from_image.inv() * other.sensor_from_image).rotation
    if phantom.seen_as == "direction":
        # Half a turn about the image's z axis is the same to directions.
        return bool(min(step.magnitude(), in_plane_mirror(step).magnitude()) > _APART_RAD)
    right_down = points.pixels.max(axis=0)
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * right_down
    places = [
        chain.sensor_from_image.apply(np.column_stack([corners * chain.pixel_mm, np.zeros(4)]))
        for chain in (one, other)
    ]
    far = float(np.linalg.norm(places[0] - places[1], axis=1).max())
    return bool(step.magnitude() > _APART_RAD or far > _APART * np.linalg.norm(right_down * one.pixel_mm))


def probe_parameters(
    fixed_pixels: bool, pixel_mm: FloatArray | None
) -> tuple[tuple[str, ...], FloatArray | None]:
    """Which of `PROBE` to estimate, and the pixel size to hold, if any.

    Raises
    ------
    InvalidInputError
        If the pixel size is neither fitted nor given.
    """
    if not fixed_pixels:
        return PROBE, None
    if pixel_mm is None:
        raise InvalidInputError("pixel_mm: expected the scanner's pixel size unless it is fitted, got none")
    return POSE, np.asarray(pixel_mm, dtype=float)


# 4. The plane in three stages (TR 303, appendix A)


def calibrate_plane(
    lines: ImagePoints, pixel_mm: FloatArray | None = None, settings: PlaneFit | None = None
) -> Solution:
    """Calibrate a 6-DOF sensor from lines of a plane: the floor of a water bath, or the Cambridge phantom.

    Parameters
    ----------
    lines : ImagePoints
        Two points of the plane's line in each frame (`ImagePoints.of_lines`).
    pixel_mm : ndarray, shape (2,), optional
        Column pitch and row spacing from the scanner's calipers; needed if they are fixed.

    Raises
    ------
    InsufficientDataError
        If there are too few lines, they contradict each other or the pixel size, or the motion does not
        determine the answer; then the missing motions are named.
    """
    s = settings or PlaneFit()
    if len(lines) < 2 * _FEWEST_LINES:
        raise InsufficientDataError(
            f"expected lines in at least {_FEWEST_LINES} frames, got {len(lines) // 2}"
        )
    probe, fixed_mm = probe_parameters(s.fixed_pixels, pixel_mm)
    prior = None
    if fixed_mm is None and pixel_mm is not None and np.isfinite(s.pixel_error):
        prior = PixelPrior(np.asarray(pixel_mm, dtype=float), s.pixel_error)
    solution = _from_stages(lines, Problem(Plane(), probe, s.outlier_sigma, prior), fixed_mm)
    if prior is not None and np.abs(prior.deviation(solution.chain.pixel_mm)).max() > _CONTRADICTS:
        # Lines that contradict the pixel size given are believed if they determine it by themselves.
        solution = _from_stages(lines, Problem(Plane(), probe, s.outlier_sigma), None)
    return _facing_up(require_adequate(solution))


def hemisphere() -> FloatArray:
    """Unit vectors spread evenly over the hemisphere z >= 0, the pole first, shape (30, 3)."""
    k = np.arange(_NORMALS)
    z, around = 1.0 - k / _NORMALS, k * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - z**2)
    return np.column_stack([flat * np.cos(around), flat * np.sin(around), z])


def angle_starts(
    directions: ImagePoints, pixel_mm: FloatArray | None, normals: FloatArray, level: bool = False
) -> list[Chain]:
    """First stage: angles with which line directions lie in a plane, whatever the mounting; the best first.

    A line of the plane is square to its normal, wherever the plane is. For one of some normals that is linear
    in the image's two axes, whose common length is not told: the eigenvector of the least eigenvalue, with
    weights for nearly least absolute residuals. The best are refined with the normal.

    Parameters
    ----------
    directions : ImagePoints
        See `as_directions`.
    pixel_mm : ndarray, shape (2,), optional
        In any unit; without it, the lengths of the axes tell the pixels' shape.
    normals : ndarray, shape (k, 3)
        Of the plane, in the world.
    level : bool
        The normal stays what it is.

    Returns
    -------
    list of Chain
        Without distances.
    """
    sizes = np.tile(np.ones(2) if pixel_mm is None else pixel_mm, (len(normals), 1))
    along = directions.pixels * sizes[0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    up = np.einsum("ki,nij->knj", normals, directions.turns)
    rows = (up[..., None] * along[:, None]).reshape(len(normals), -1, 6)
    sines = np.ones(rows.shape[:2])
    for _ in range(_ROUNDS):
        weighted = rows * absolute_weights(sines, axis=1)[..., None]
        axes = np.linalg.eigh(np.swapaxes(weighted, 1, 2) @ rows)[1][..., :1]
        sines = np.abs(rows @ axes)[..., 0]
    across = axes.reshape(-1, 3, 2)
    lengths = np.linalg.norm(across, axis=1)
    turns = nearest_rotation(across / lengths[:, None])
    if pixel_mm is None:
        sizes[:, 0] = np.clip(lengths[:, 0] / lengths[:, 1], 1.0 / OBLONG, OBLONG)
    seen = directions.pixels * sizes[:, None]
    seen /= np.linalg.norm(seen, axis=2, keepdims=True)
    costs = np.abs(np.einsum("knb,kbc,knc->kn", up, turns[..., :2], seen)).mean(axis=1)
    phantom = line_directions(level)
    equations = Equations.of(directions.of_some_frames(_ANGLE_FRAMES), phantom)
    ends = list[tuple[float, Chain]]()
    for number in np.argsort(costs)[:_REFINED]:
        pose = Rotation.from_matrix(turns[number]), rotation_to_z(normals[number])
        start = Chain(sizes[number], *map(RigidTransform.from_rotation, pose))
        end = nearly_absolute(equations, start, (*ANGLES, *phantom.determined), _ROUNDS)
        # The world is turned as little as puts the plane's normal upright.
        upright = rotation_to_z(end.target_from_world.rotation.as_matrix()[2])
        end = replace(end, target_from_world=RigidTransform.from_rotation(upright))
        ends.append((float(np.abs(equations.residuals(end)).mean()), end))
    ends.sort(key=lambda one: one[0])
    kept = list[Chain]()
    for cost, end in ends:
        hopeless = cost > _HOPELESS * ends[0][0] + _TINY
        if not hopeless and all(apart(end, one, directions, phantom) for one in kept):
            kept.append(end)
    return kept[:_KEPT]


def in_plane_mirror(rotation: Rotation) -> Rotation:
    """The other rotation that explains the same line directions: half a turn in the image plane."""
    return rotation * Rotation.from_euler("z", np.pi)


def rotation_to_z(normal: FloatArray) -> Rotation:
    """A rotation that turns a plane's normal into the z axis."""
    return Rotation.align_vectors([[0.0, 0.0, 1.0]], [normal])[0]


def _from_stages(lines: ImagePoints, problem: Problem, fixed_mm: FloatArray | None) -> Solution:
    """Angles from line directions, then distances, then all."""
    few = lines.of_some_frames(SOME_FRAMES)
    pixel_mm = fixed_mm if problem.prior is None else problem.prior.pixel_mm
    directions = as_directions(few, np.ones(2) if pixel_mm is None else pixel_mm)
    angles = angle_starts(directions, pixel_mm, hemisphere())
    return problem.best(lines, [_with_distances(few, one, pixel_mm) for one in angles])


def _with_distances(lines: ImagePoints, angles: Chain, pixel_mm: FloatArray | None) -> Chain:
    """Second stage: linear distances, for the image or its in-plane mirror, which they tell apart."""
    up = angles.target_from_world.rotation.as_matrix()[2] @ lines.turns
    square = angles.pixel_mm if pixel_mm is None else pixel_mm
    ends = list[tuple[float, Chain]]()
    for turn in (angles.sensor_from_image.rotation, in_plane_mirror(angles.sensor_from_image.rotation)):
        height = np.sum(up * ((lines.pixels * square) @ turn.as_matrix()[:, :2].T), axis=1)
        unknown = [up, np.ones((len(lines), 1))]
        target_mm = -lines.shifts_mm @ angles.target_from_world.rotation.as_matrix()[2]
        if pixel_mm is None:
            unknown.append(height[:, None])
        else:
            target_mm = target_mm - height
        found, left = robust_linear(np.hstack(unknown), target_mm)
        size = square * (found[4] if pixel_mm is None else 1.0)
        if size[1] < 0:
            turn, size = in_plane_mirror(turn), -size
        probe = RigidTransform.from_components(found[:3], turn)
        shift = RigidTransform.from_translation([0.0, 0.0, found[3]])
        median = float(np.median(np.abs(left)))
        ends.append((median, Chain(size, probe, shift * angles.target_from_world)))
    return min(ends, key=lambda one: one[0])[1]


def _facing_up(solution: Solution) -> Solution:
    """The same solution with the plane's normal on the probe's side: heights of images are positive."""
    heights = solution.chain.target_from_image(solution.points).translation[:, 2]
    if np.median(heights) >= 0:
        return solution
    over = RigidTransform.from_rotation(Rotation.from_euler("x", np.pi))
    chain = replace(solution.chain, target_from_world=over * solution.chain.target_from_world)
    return replace(solution, chain=chain, residuals=-solution.residuals)
