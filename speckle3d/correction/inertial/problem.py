"""Motion along the elevational axis that accelerometer, gyroscope and image steps have in common.

One sparse least-squares problem. Unknown functions of time, quintic B-splines because an accelerometer feels
the second derivative: elevational position of the image's centre, and what the probe turns about x and y
beyond the smoothed orientation readings. Unknown numbers: `GLOBALS`.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.sparse.linalg import SuperLU, splu

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.leastsquares import cauchy_weights

GLOBALS = (
    "log_scale",
    "log_scale_slope",
    "clock_s",
    "lever_x_mm",
    "lever_y_mm",
    "lever_z_mm",
    "force_m_s2",
    "rate_x_rad_s",
    "rate_y_rad_s",
    "quadrature_mm2",
)
"""Numbers that are found together with the motion. The first is ln(true length / the images'), the second
its change from the first to the last frame; the clock's offset is added to the frames' times; the lever is
from the image's centre to the sensor; the force is
the accelerometer's bias and what gravity leaks in."""

GRAVITY_M_S2 = 9.80665

_SCALE, _SLOPE, _CLOCK, _LEVER, _FORCE, _RATE, _QUADRATURE = 0, 1, 2, slice(3, 6), 6, slice(7, 9), 9
_DEGREE = 5
_PROBES = 8
_ROUNDS = 12
_SETTLED = 0.03
"""Change of the globals, over the deviation that each would have were all others known, at which iteration
stops."""
_FREE_M_S2, _FREE_RAD_S2 = 30.0, 300.0
"""Accelerations that no hand exceeds: a prior that matters only where nothing was measured."""
_ANCHORS_HZ, _ANCHOR_RAD = 2.0, float(np.deg2rad(0.5))
"""How often and how well smoothed orientation readings tell the turns: twice a second, to as much as the
inclination of a good sensor wanders. Faster turns are the gyroscope's."""
_FAR_MM = 1e3
"""No sweep goes farther; where it begins is free."""
_CLEAR_MM = 0.02
"""Step below which its own quadrature bias fades: its sign is then noise, too."""


@dataclass(frozen=True)
class Readings:
    """An inertial sensor's readings in the image's axes, on the image's clock.

    Attributes
    ----------
    time_s : ndarray, shape (m,)
    force_m_s2 : ndarray, shape (m,)
        Specific force along the elevational axis.
    rate_rad_s : ndarray, shape (m, 2)
        Angular rate about x and y.
    up : ndarray, shape (m, 3)
        Smoothed direction of up.
    turn_rate_rad_s, turn_rad_s2 : ndarray, shape (m, 3)
        Rate and acceleration of the smoothed turning.
    force_sigma, rate_sigma : float
        White noise of a reading, m/s^2 and rad/s.
    """

    time_s: FloatArray
    force_m_s2: FloatArray
    rate_rad_s: FloatArray
    up: FloatArray
    turn_rate_rad_s: FloatArray
    turn_rad_s2: FloatArray
    force_sigma: float
    rate_sigma: float


@dataclass(frozen=True)
class ImageSteps:
    """Elevational steps between neighbouring frames as the images have them.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
    steps_mm : ndarray, shape (n - 1,)
    sigma_mm : ndarray, shape (n - 1,)
    """

    time_s: FloatArray
    steps_mm: FloatArray
    sigma_mm: FloatArray


@dataclass(frozen=True)
class Prior:
    """Mean and standard deviation of `GLOBALS`, each shape (10,)."""

    mean: FloatArray
    sigma: FloatArray


@dataclass(frozen=True)
class Solution:
    """The motion and the numbers that fit best.

    Attributes
    ----------
    values : ndarray, shape (10,)
        `GLOBALS`.
    covariance : ndarray, shape (10, 10)
    travel_mm : ndarray, shape (n,)
        True elevational position at the frames.
    image_residuals, force_residuals : ndarray
        Over their standard deviations; (n - 1,) and (m,).
    rate_residuals : ndarray, shape (m, 2)
    influence : ndarray, shape (n - 1,)
        By how much log scale changes for a change of a step by its standard deviation.
    weights : ndarray, shape (n - 1,)
    leverage : ndarray, shape (n - 1,)
        Share of a step's error that the fit follows.
    cost : float
        Sum of squared weighted residuals.
    """

    values: FloatArray
    covariance: FloatArray
    travel_mm: FloatArray
    image_residuals: FloatArray
    force_residuals: FloatArray
    rate_residuals: FloatArray
    influence: FloatArray
    weights: FloatArray
    leverage: FloatArray
    cost: float
    coefficients: FloatArray = field(repr=False)


class InertialProblem:
    """Least squares over the motion and `GLOBALS`.

    Parameters
    ----------
    readings : Readings
    steps : ImageSteps
    prior : Prior
    knot_hz : float
    clock_range_s : float
        Largest clock offset that may be tried.
    """

    def __init__(
        self, readings: Readings, steps: ImageSteps, prior: Prior, knot_hz: float, clock_range_s: float
    ) -> None:
        self.readings, self.steps, self.prior = readings, steps, prior
        first = min(readings.time_s[0], steps.time_s[0] - clock_range_s)
        last = max(readings.time_s[-1], steps.time_s[-1] + clock_range_s)
        self._h = 1.0 / knot_hz
        spans = int(np.ceil((last - first) * knot_hz)) + 1
        self._knots = first + self._h * np.arange(-_DEGREE, spans + _DEGREE + 1)
        self._m = self._knots.size - _DEGREE - 1
        self._phase = np.linspace(-0.5, 0.5, steps.time_s.size)
        self._phase = (self._phase[1:] + self._phase[:-1]) / 2.0
        self._anchor_s = np.arange(self._knots[_DEGREE], self._knots[-_DEGREE - 1], 1.0 / _ANCHORS_HZ)
        t = readings.time_s
        self._value, self._rate, self._acceleration = (self._basis(t, order) for order in (0, 1, 2))
        self._fixed = self._fixed_rows()

    def told(self, steps: ImageSteps, prior: Prior | None = None) -> InertialProblem:
        """The same readings with other steps of the same frames, or another prior."""
        again = copy(self)
        again.steps = steps
        if prior is not None:
            again.prior = prior
            again._fixed = again._fixed_rows()
        return again

    def solve(self, start: Solution | FloatArray | None = None, rounds: int = _ROUNDS) -> Solution:
        """Gauss-Newton from the prior's mean, from `GLOBALS`, or from a solution nearby."""
        if isinstance(start, Solution):
            x, weights = start.coefficients, cauchy_weights(self._image(start.coefficients)[1])
        else:
            values = self.prior.mean if start is None else start
            x, weights = np.concatenate([np.zeros(3 * self._m), values]), np.ones(self.steps.steps_mm.size)
        least = 0 if isinstance(start, Solution) else 2
        for turn in range(rounds):
            jacobian, residual = self._system(x, weights)
            normal = (jacobian.T @ jacobian).tocsc()
            solver = _factorised(normal)
            step = solver.solve(-(jacobian.T @ residual))
            x = x + self._limited(step)
            if turn >= least:
                weights = cauchy_weights(self._image(x)[1])
            sigma = np.sqrt(1.0 / normal.diagonal()[-len(GLOBALS) :])
            if turn > least and np.abs(step[-len(GLOBALS) :] / sigma).max() < _SETTLED:
                break
        return self._solution(x, weights)

    def sensor_misfit(self, found: Solution) -> float:
        """Squared residuals of accelerometer, gyroscope and slow orientation over those expected: about one.

        The share that the fit follows is found by random probes.

        References
        ----------
        .. [1] M. F. Hutchinson, "A stochastic estimator of the trace of the influence matrix for Laplacian
           smoothing splines", Commun. Stat. Simul. Comput. 19, 1990.
        """
        jacobian, residual = self._system(found.coefficients, found.weights)
        first = self.steps.steps_mm.size
        rows = slice(first, first + 3 * self.readings.time_s.size + 2 * self._anchor_s.size)
        sensed, left = jacobian[rows], residual[rows]
        probes = np.random.default_rng(0).choice([-1.0, 1.0], (sensed.shape[0], _PROBES))
        pulled = sensed.T @ probes
        solver = _factorised((jacobian.T @ jacobian).tocsc())
        followed = float(np.sum(pulled * solver.solve(pulled))) / _PROBES
        return float(left @ left) / max(left.size - followed, 1.0)

    def position(self, found: Solution, time_s: FloatArray) -> FloatArray:
        """Elevational position at any times on the sensor's clock, mm."""
        return np.asarray(self._basis(time_s, 0) @ found.coefficients[0 : 3 * self._m : 3])

    def _limited(self, step: FloatArray) -> FloatArray:
        """Limit the change of scale and clock, whose effect is not linear."""
        at = 3 * self._m
        step = step.copy()
        step[at + _SCALE] = np.clip(step[at + _SCALE], -0.3, 0.3)
        step[at + _SLOPE] = np.clip(step[at + _SLOPE], -0.3, 0.3)
        step[at + _CLOCK] = np.clip(step[at + _CLOCK], -0.02, 0.02)
        return step

    def _solution(self, x: FloatArray, weights: FloatArray) -> Solution:
        jacobian, residual = self._system(x, weights)
        solver = _factorised((jacobian.T @ jacobian).tocsc())
        size, k = x.size, len(GLOBALS)
        unit = np.zeros((size, k))
        unit[np.arange(size - k, size), np.arange(k)] = 1.0
        columns = solver.solve(unit)
        n, m = self.steps.steps_mm.size, self.readings.time_s.size
        images = jacobian[:n]
        leverage = np.einsum("ij,ji->i", images.toarray(), solver.solve(images.T.toarray()))
        _, image = self._image(x)
        return Solution(
            values=x[-k:].copy(),
            covariance=columns[-k:],
            travel_mm=self._basis(self.steps.time_s + x[3 * self._m + _CLOCK], 0) @ x[0 : 3 * self._m : 3],
            image_residuals=image,
            force_residuals=residual[n : n + m],
            rate_residuals=residual[n + m : n + 3 * m].reshape(2, m).T,
            influence=np.sqrt(weights) * (images @ columns[:, _SCALE]),
            weights=weights,
            leverage=leverage,
            cost=float(residual @ residual),
            coefficients=x,
        )

    def _basis(self, time_s: FloatArray, order: int) -> sparse.csr_matrix:
        """Derivatives of the B-splines at some times, one column per coefficient."""
        rows: Any = BSpline.design_matrix(time_s, self._knots, _DEGREE - order)
        for _ in range(order):
            rows = (rows[:, :-1] - rows[:, 1:]) / self._h
        return sparse.csr_matrix(rows)

    def _interleaved(self, *blocks: sparse.spmatrix) -> sparse.csr_matrix:
        """Columns of position, tilt and yaw coefficient by coefficient, so that little fills in."""
        order = np.arange(3 * self._m).reshape(3, self._m).T.ravel()
        return sparse.csr_matrix(sparse.hstack(blocks).tocsc()[:, order])

    def _fixed_rows(self) -> sparse.csr_matrix:
        """Rows of angular rate, anchors and limits of the motion, priors: linear, over their sigma."""
        r, m = self.readings, self._m
        none = sparse.csr_matrix(self._rate.shape)
        one = np.ones(r.time_s.size)
        rates = [
            self._with_globals(self._interleaved(none, self._rate, none), {_RATE.start: one}),
            self._with_globals(self._interleaved(none, none, self._rate), {_RATE.start + 1: one}),
        ]
        anchors = self._basis(self._anchor_s, 0)
        empty = sparse.csr_matrix(anchors.shape)
        knots = self._knots[_DEGREE:-_DEGREE]
        bend = self._basis(knots, 2)
        still = sparse.csr_matrix(bend.shape)
        plain = [
            self._interleaved(empty, anchors, empty) / _ANCHOR_RAD,
            self._interleaved(empty, empty, anchors) / _ANCHOR_RAD,
            self._interleaved(bend, still, still) / (1e3 * _FREE_M_S2),
            self._interleaved(still, bend, still) / _FREE_RAD_S2,
            self._interleaved(still, still, bend) / _FREE_RAD_S2,
            self._interleaved(anchors, empty, empty) / _FAR_MM,
        ]
        prior = sparse.hstack(
            [sparse.csr_matrix((len(GLOBALS), 3 * m)), sparse.diags(1.0 / self.prior.sigma)]
        )
        return sparse.csr_matrix(
            sparse.vstack(
                [each / r.rate_sigma for each in rates]
                + [self._with_globals(each, {}) for each in plain]
                + [prior]
            )
        )

    def _with_globals(self, rows: sparse.spmatrix, columns: dict[int, FloatArray]) -> sparse.csr_matrix:
        dense = np.zeros((rows.shape[0], len(GLOBALS)))
        for index, column in columns.items():
            dense[:, index] = column
        return sparse.csr_matrix(sparse.hstack([rows, sparse.csr_matrix(dense)]))

    def _system(self, x: FloatArray, weights: FloatArray) -> tuple[sparse.csr_matrix, FloatArray]:
        """Jacobian and residuals over their standard deviations: images, force, rate, priors."""
        images, image = self._image(x)
        force_rows, force = self._force(x)
        rest = self._fixed @ x
        m = self.readings.time_s.size
        measured = (self.readings.rate_rad_s - self.readings.turn_rate_rad_s[:, :2]).T.ravel()
        rest[: 2 * m] -= measured / self.readings.rate_sigma
        rest[-len(GLOBALS) :] -= self.prior.mean / self.prior.sigma
        root = np.sqrt(weights)
        jacobian = sparse.vstack([sparse.diags(root) @ images, force_rows, self._fixed])
        return sparse.csr_matrix(jacobian), np.concatenate([root * image, force, rest])

    def _image(self, x: FloatArray) -> tuple[sparse.csr_matrix, FloatArray]:
        values, z = x[-len(GLOBALS) :], x[0 : 3 * self._m : 3]
        at = self.steps.time_s + values[_CLOCK]
        here, speed = self._basis(at, 0), self._basis(at, 1) @ z
        across = here[1:] - here[:-1]
        shrink = np.exp(-values[_SCALE] - values[_SLOPE] * self._phase)
        seen = shrink * (across @ z)
        near = seen**2 + _CLEAR_MM**2
        grown = np.sqrt(1.0 + np.maximum(values[_QUADRATURE], -0.5 * _CLEAR_MM**2) / near)
        gain = grown + (1.0 - grown**2) / grown * seen**2 / near
        sigma = self.steps.sigma_mm
        none = sparse.csr_matrix(across.shape)
        rows = self._with_globals(
            self._interleaved(sparse.diags(gain * shrink) @ across, none, none),
            {
                _SCALE: -gain * seen,
                _SLOPE: -gain * seen * self._phase,
                _CLOCK: gain * shrink * np.diff(speed),
                _QUADRATURE: seen / (2.0 * grown * near),
            },
        )
        return sparse.csr_matrix(sparse.diags(1.0 / sigma) @ rows), (
            seen * grown - self.steps.steps_mm
        ) / sigma

    def _force(self, x: FloatArray) -> tuple[sparse.csr_matrix, FloatArray]:
        r, values = self.readings, x[-len(GLOBALS) :]
        lever = values[_LEVER]
        parts = [x[c : 3 * self._m : 3] for c in range(3)]
        turned = [r.turn_rad_s2[:, axis] + self._acceleration @ parts[axis + 1] for axis in (0, 1)]
        rate = r.turn_rate_rad_s.copy()
        for axis in (0, 1):
            rate[:, axis] += self._rate @ parts[axis + 1]
        arms = 1e-3 * np.column_stack(
            [
                rate[:, 2] * rate[:, 0] - turned[1],
                rate[:, 2] * rate[:, 1] + turned[0],
                -(rate[:, 0] ** 2) - rate[:, 1] ** 2,
            ]
        )
        g = GRAVITY_M_S2
        model = (
            1e-3 * (self._acceleration @ parts[0])
            + arms @ lever
            + g * (r.up[:, 2] - r.up[:, 1] * (self._value @ parts[1]) + r.up[:, 0] * (self._value @ parts[2]))
            + values[_FORCE]
        )
        inward = 1e-3 * (np.multiply.outer(rate[:, 2], lever[:2]) - 2.0 * lever[2] * rate[:, :2])
        turning = [sparse.diags(column) @ self._rate for column in inward.T]
        by_tilt = 1e-3 * lever[1] * self._acceleration - sparse.diags(g * r.up[:, 1]) @ self._value
        by_yaw = -1e-3 * lever[0] * self._acceleration + sparse.diags(g * r.up[:, 0]) @ self._value
        columns: dict[int, FloatArray] = {_LEVER.start + k: arms[:, k] for k in range(3)}
        columns[_FORCE] = np.ones(r.time_s.size)
        rows = self._with_globals(
            self._interleaved(1e-3 * self._acceleration, by_tilt + turning[0], by_yaw + turning[1]), columns
        )
        return sparse.csr_matrix(rows / r.force_sigma), (model - r.force_m_s2) / r.force_sigma


def _factorised(normal: sparse.csc_matrix) -> SuperLU:
    """Factors of the normal equations in their own order, which keeps neighbours in time together."""
    try:
        return splu(normal, permc_spec="NATURAL", diag_pivot_thresh=0.0)
    except RuntimeError as error:
        raise InsufficientDataError(
            "inertial scale: expected readings that determine the motion, got some that do not "
            f"({error}); are their units right?"
        ) from error
