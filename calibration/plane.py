"""The plane module: from pixels to a plane in space, in the order of TR 303 [1]_, section 3 and appendix A.

A pixel (u, v) of size (s_x, s_y) is carried by ``target_from_world * world_from_sensor * sensor_from_image``
into the phantom's frame, where the phantom says which components must vanish: for a plane the height above
it, equation 8; `wires` and `orientation` bring their own. Fourteen parameters in all; those that a phantom
leaves undetermined are held. Which frames count, and how certain the answer is, stands in `solution`.

Parameters are refined as small displacements in the image's own frame and in the phantom's: there no angle
is near a singularity, wherever the sensor is mounted, and all are of one scale.

References
----------
.. [1] R. W. Prager et al., "Automatic calibration for 3-D free-hand ultrasound", CUED/F-INFENG/TR 303, 1997.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.motion import OBLONG, require_adequate
from calibration.points import ANGLES, CHAIN, SOME_FRAMES, ImagePoints, SeenAs, as_directions, columns_of
from calibration.robust import absolute_weights, robust_linear
from calibration.settings import PlaneFit
from calibration.solution import UNKNOWN, Prior, Problem, Solution, are_distinct
from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import nearest_rotation

_NORMALS = 30
"""About 26 degrees apart: refinement converges from further away."""
_MOST_STEPS = 100
_TOLERANCE, _ROUGHLY = 1e-9, 1e-3
"""Relative decrease of the sum of squares that a last step promises; of a sum that is weighted anew."""
_REWEIGHTINGS = 8
_REFINEMENTS, _MOST_STARTS, _ANGLE_FRAMES, _ROUNDS = 6, 3, 30, 4
"""Normals whose angles are refined, from so many frames with so many reweightings, and those that go on."""
_HOPELESS = 3.0
"""Ends whose mean absolute residual is as many times the least are not looked at again."""
_TINY = 1e-12
"""Of a normal matrix's diagonal, where residuals do not depend on a parameter at all."""
_HALF_TURN_X = np.diag([1.0, -1.0, -1.0, 1.0])


# 1. The chain: image -> sensor -> world -> phantom (TR 303, section 3)


@dataclass(frozen=True)
class Chain:
    """An estimate of all fourteen parameters.

    Attributes
    ----------
    pixel_mm : ndarray, shape (2,)
        Column pitch and row spacing.
    probe, target : ndarray, shape (4, 4)
        Sensor from image, and target (the phantom) from world, mm.
    """

    pixel_mm: FloatArray
    probe: FloatArray
    target: FloatArray

    @cached_property
    def sensor_from_image(self) -> RigidTransform:
        """Sensor from image: R_T_P of TR 303."""
        return RigidTransform.from_matrix(self.probe)

    @cached_property
    def target_from_world(self) -> RigidTransform:
        """Target from world: C_T_T of TR 303."""
        return RigidTransform.from_matrix(self.target)

    def target_from_image(self, points: ImagePoints) -> RigidTransform:
        """Pose of the image of each point in the phantom's frame."""
        return self.target_from_world * points.world_from_sensor * self.sensor_from_image

    def displace(self, step: FloatArray) -> Chain:
        """Displace the image in its frame and the world in the phantom's, `step` in the order of `CHAIN`.

        A pixel size that becomes negative is made positive by turning the image by half about its other axis,
        which is the same calibration; TR 303, appendix C, does so with angles.
        """
        size = self.pixel_mm + step[:2]
        sign = np.where(size < 0, -1.0, 1.0)
        turns = Rotation.from_rotvec([step[7:4:-1], step[13:10:-1]]).as_matrix()
        of_image, of_target = np.eye(4), np.eye(4)
        of_image[:3, :3], of_image[:3, 3] = turns[0] * [*sign, sign.prod()], step[2:5]
        of_target[:3, :3], of_target[:3, 3] = turns[1], step[8:11]
        return Chain(np.abs(size), self.probe @ of_image, of_target @ self.target)

    def half_turn(self, axis: int, centre_mm: FloatArray | float = 0.0) -> Chain:
        """Turn the image by half about one of its axes through a place in it."""
        turn = np.diag([*(2.0 * np.eye(3)[axis] - 1.0), 1.0])
        turn[:3, 3] = (1.0 - np.diag(turn)[:3]) * centre_mm
        return replace(self, probe=self.probe @ turn)

    def mirror(self) -> Chain:
        """Turn the image by half in its plane: lines of a plane have the same directions."""
        return self.half_turn(2)


@dataclass(frozen=True)
class Phantom:
    """A plane through the origin of its own frame, or a point there.

    Attributes
    ----------
    unknowns : tuple of str
        Those of `TARGET` that images of the phantom determine.
    seen_as : str
        What the points are.
    across : tuple of tuple of float, shape (r, 3)
        Directions along which a point's distance from the origin must vanish: the plane's normal (TR 303,
        equation 8), or all three (equation 3).
    """

    unknowns: tuple[str, ...]
    seen_as: SeenAs
    across: tuple[tuple[float, ...], ...] = ((0.0, 0.0, 1.0),)

    def equations(self, points: ImagePoints) -> Equations:
        """Residual equations of some points."""
        rows = np.broadcast_to(self.across, (len(points), len(self.across), 3))
        return Equations(points, rows, np.zeros(rows.shape[:2]))


PLANE = Phantom(("z_c", "beta_c", "gamma_c"), "line")


def line_directions(level: bool = False) -> Phantom:
    """A plane of which line directions alone are used, wherever it is (TR 303, appendix A; Housden 2008).

    `ImagePoints.pixels` then holds directions (`as_directions`), and the poses have no translation: what
    vanishes is the sine of the angle between line and plane. A level one's normal is the world's z axis.
    """
    return Phantom(() if level else ("beta_c", "gamma_c"), "direction")


# 2. Residuals, their derivatives, and least squares


@dataclass(frozen=True)
class Equations:
    """Residual equations of points of a phantom.

    Attributes
    ----------
    rows, offsets : ndarray, shapes (n, r, 3) and (n, r)
        ``rows @ position - offsets`` is the residual, mm.
    """

    points: ImagePoints
    rows: FloatArray
    offsets: FloatArray

    def __getitem__(self, index: BoolArray) -> Equations:
        return Equations(self.points[index], self.rows[index], self.offsets[index])

    def residuals(self, chain: Chain) -> FloatArray:
        """Residuals, shape (n, r)."""
        return np.asarray(np.einsum("nri,ni->nr", self.rows, self._places(chain)[1]) - self.offsets)

    def at(self, chain: Chain) -> tuple[FloatArray, FloatArray]:
        """Residuals, (n, r), and derivatives by the small displacements of `Chain.displace`, (n, r, 14)."""
        rows, (flat, place) = self.rows, self._places(chain)
        in_sensor = np.einsum("nri,nij->nrj", rows @ chain.target[:3, :3], self.points.turns)
        in_image = in_sensor @ chain.probe[:3, :3]
        slopes = np.concatenate(
            [
                in_image[..., :2] * self.points.pixels[:, None],
                in_image,
                _cross_zyx(flat[:, None], in_image),
                rows,
                _cross_zyx(place[:, None], rows),
            ],
            axis=2,
        )
        return np.einsum("nri,ni->nr", rows, place) - self.offsets, slopes

    def _places(self, chain: Chain) -> tuple[FloatArray, FloatArray]:
        """Where the points are in the image's frame and in the phantom's, mm, shape (n, 3) each."""
        flat = np.zeros((len(self.points), 3))
        flat[:, :2] = self.points.pixels * chain.pixel_mm
        in_sensor = flat @ chain.probe[:3, :3].T + chain.probe[:3, 3]
        in_world = np.einsum("nij,nj->ni", self.points.turns, in_sensor) + self.points.shifts_mm
        return flat, in_world @ chain.target[:3, :3].T + chain.target[:3, 3]

    def least_squares(
        self,
        start: Chain,
        free: Sequence[str],
        prior: Prior = UNKNOWN,
        sigma: float = 1.0,
        tolerance: float = _TOLERANCE,
    ) -> Chain:
        """Minimise the sum of squares by Levenberg's and Marquardt's steps, in frames that move along.

        Parameters
        ----------
        prior : Prior, optional
            Counts as further residuals of standard deviation `sigma`.
        tolerance : float
            Relative decrease of the sum of squares below which a step is the last.

        Raises
        ------
        InsufficientDataError
            If there are fewer residuals than parameters.
        """
        columns = columns_of(free)
        weight = sigma / prior.sigma[columns]

        def at(chain: Chain) -> tuple[FloatArray, FloatArray, float]:
            values, slopes = self.at(chain)
            r, j = values.ravel(), slopes.reshape(values.size, -1)[:, columns]
            away = weight * prior.displacement(chain)[columns]
            return j.T @ j + np.diag(weight**2), j.T @ r + weight * away, float(r @ r + away @ away)

        chain, (normal, pull, cost) = start, at(start)
        count = self.offsets.size + np.count_nonzero(weight)
        if count < len(columns):
            raise InsufficientDataError(
                f"expected at least {len(columns)} residuals, got {count}: the phantom in more frames"
            )
        damping, step = 1e-6, np.zeros(len(CHAIN))
        for _ in range(_MOST_STEPS):
            descent = np.linalg.solve(normal + damping * np.diag(np.maximum(np.diag(normal), _TINY)), pull)
            step[columns] = -descent
            trial = chain.displace(step)
            system, decrease = at(trial), float(descent @ pull)
            if system[2] <= cost:
                chain, (normal, pull, cost), damping = trial, system, max(damping / 10.0, 1e-12)
            else:
                damping = max(10.0 * damping, 1e-6)
            if decrease <= tolerance * cost + count * np.finfo(float).eps ** 2 or damping > 1e6:
                break
        return chain

    def least_absolute(self, start: Chain, free: Sequence[str], rounds: int = _REWEIGHTINGS) -> Chain:
        """Nearly least absolute residuals, by reweighting, so that wrong frames pull little."""
        chain, before = start, np.inf
        for _ in range(rounds):
            size = np.abs(self.residuals(chain))
            if size.mean() > 0.99 * before:
                break
            before, factor = size.mean(), np.sqrt(absolute_weights(size))
            weighted = Equations(self.points, factor[..., None] * self.rows, factor * self.offsets)
            chain = weighted.least_squares(chain, free, tolerance=_ROUGHLY)
        return chain


def _cross_zyx(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product, its z component first; NumPy's own takes five times as long."""
    first, second = [0, 2, 1], [1, 0, 2]
    return a[..., first] * b[..., second] - a[..., second] * b[..., first]


# 3. The plane in three stages (TR 303, appendix A)


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
    problem = Problem.of(PLANE, pixel_mm, s, s.pixel_error)
    solution = _from_stages(lines, problem)
    if solution.contradicts_prior:
        # Lines that contradict the pixel size given are believed if they determine it by themselves.
        solution = _from_stages(lines, replace(problem, prior=UNKNOWN))
    return _facing_up(require_adequate(solution))


def _from_stages(lines: ImagePoints, problem: Problem) -> Solution:
    """Solve for angles from line directions, then distances, then all parameters."""
    few, pixel_mm = lines.of_some_frames(SOME_FRAMES), problem.prior.known_pixel_mm
    directions = as_directions(few, np.ones(2) if pixel_mm is None else pixel_mm)
    angles = angle_starts(directions, pixel_mm, hemisphere())
    return problem.best(lines, [_with_distances(few, start, pixel_mm) for start in angles])


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
        weights = absolute_weights(sines, axis=1)[..., None]
        axes = np.linalg.eigh(np.swapaxes(weights * rows, 1, 2) @ rows)[1][..., :1]
        sines = np.abs(rows @ axes)[..., 0]
    across = axes.reshape(-1, 3, 2)
    # Lines all along one axis of the image say nothing of the other.
    lengths = np.maximum(np.linalg.norm(across, axis=1), np.finfo(float).tiny)
    turns = nearest_rotation(across / lengths[:, None])
    if pixel_mm is None:
        sizes[:, 0] = np.clip(lengths[:, 0] / lengths[:, 1], 1.0 / OBLONG, OBLONG)
    units = directions.pixels * sizes[:, None]
    units /= np.linalg.norm(units, axis=2, keepdims=True)
    costs = np.abs(np.einsum("knb,kbc,knc->kn", up, turns[..., :2], units)).mean(axis=1)
    phantom = line_directions(level)
    equations = phantom.equations(directions.of_some_frames(_ANGLE_FRAMES))
    ends = list[tuple[float, Chain]]()
    for number in np.argsort(costs)[:_REFINEMENTS]:
        start = Chain(sizes[number], np.eye(4), turn_upright(normals[number]))
        start.probe[:3, :3] = turns[number]
        end = equations.least_absolute(start, (*ANGLES, *phantom.unknowns), _ROUNDS)
        end = replace(end, target=turn_upright(end.target[2, :3]))
        ends.append((float(np.abs(equations.residuals(end)).mean()), end))
    ends.sort(key=lambda end: end[0])
    starts = list[Chain]()
    for cost, end in ends:
        hopeful = cost < _HOPELESS * ends[0][0] + _TINY
        if hopeful and all(are_distinct(end, start, directions, phantom) for start in starts):
            starts.append(end)
    return starts[:_MOST_STARTS]


def turn_upright(normal: FloatArray) -> FloatArray:
    """Turn the world as little as makes a plane's normal the z axis, shape (4, 4)."""
    target = np.eye(4)
    target[:3, :3] = Rotation.align_vectors([[0.0, 0.0, 1.0]], [normal])[0].as_matrix()
    return target


def _with_distances(lines: ImagePoints, angles: Chain, pixel_mm: FloatArray | None) -> Chain:
    """Second stage: linear distances and the pixels' size, negative for the image's in-plane mirror."""
    normal = angles.target[2, :3]
    up, flat = normal @ lines.turns, lines.pixels * angles.pixel_mm
    height = np.sum(up * (flat @ angles.probe[:3, :2].T), axis=1)
    unknown = np.column_stack([up, np.ones(len(lines)), height])
    answer, _ = robust_linear(unknown, -lines.shifts_mm @ normal)
    near = angles if answer[4] > 0 else angles.mirror()
    size = abs(answer[4]) * angles.pixel_mm if pixel_mm is None else pixel_mm
    chain = Chain(size, near.probe.copy(), near.target.copy())
    chain.probe[:3, 3], chain.target[2, 3] = answer[:3], answer[3]
    return chain


def _facing_up(solution: Solution) -> Solution:
    """Solution with the plane's normal on the probe's side: heights of images are positive."""
    chain, points = solution.chain, solution.points
    origins = points.turns @ chain.probe[:3, 3] + points.shifts_mm
    if np.median(origins @ chain.target[2, :3]) + chain.target[2, 3] >= 0:
        return solution
    chain = replace(chain, target=_HALF_TURN_X @ chain.target)
    return replace(solution, chain=chain, residuals=-solution.residuals)
