"""Smoothing an orientation backward, its heading, and the orientation of every sample: loops over steps.

`xsens.fusion.smoothing` says what is done and why.
"""

import math

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.orientation import SMOOTHED, FilterSteps
from speckle3d.kernels.rotations import (
    apply_into,
    multiplied,
    product_into,
    quaternion_from,
    quaternion_of,
    solve_into,
    turn_into,
    vector_of,
)

HEADING_STATES = 5
"""Angle to north, what is left of the bias (sensor axes), and the field's own stray."""


@njit(cache=True, nogil=True, error_model="numpy")
def _rauch(
    transition: FloatArray,
    noise: FloatArray,
    covariance: FloatArray,
    after: FloatArray,
    gain: FloatArray,
    predicted: FloatArray,
    wide: FloatArray,
) -> None:
    """One step back of Rauch, Tung and Striebel: fill the gain's transpose, smooth the covariance in place.

    Parameters
    ----------
    transition, noise : ndarray, shapes (s, s) and (s,)
        From this step to the next.
    covariance : ndarray, shape (s, s)
        After this step's correction; becomes the smoothed one.
    after : ndarray, shape (s, s)
        The next step's smoothed covariance.
    gain, predicted, wide : ndarray, shape (s, s)
        `gain` is filled, the others are buffers.
    """
    size = noise.shape[0]
    for i in range(size):
        for j in range(size):
            wide[i, j] = 0.0
        for k in range(size):
            factor = transition[i, k]
            if factor != 0.0:
                for j in range(size):
                    wide[i, j] += factor * covariance[k, j]
    for i in range(size):
        for j in range(size):
            total = noise[i] if i == j else 0.0
            for k in range(size):
                total += wide[i, k] * transition[j, k]
            predicted[i, j] = total
            gain[i, j] = wide[i, j]
    wide[:] = predicted
    solve_into(wide, gain)  # the covariance is symmetric
    for i in range(size):
        for j in range(size):
            total = 0.0
            for k in range(size):
                total += (after[i, k] - predicted[i, k]) * gain[k, j]
            wide[i, j] = total
    for i in range(size):
        for j in range(size):
            total = 0.0
            for k in range(size):
                total += gain[k, i] * wide[k, j]
            covariance[i, j] += total


@njit(cache=True, nogil=True, error_model="numpy")
def smooth_steps(
    steps: FilterSteps, first: int, matrices: FloatArray, biases: FloatArray, sd_rad: FloatArray
) -> None:
    """Smooth the steps from `first` on (Rauch-Tung-Striebel); before, go back by the gyroscope.

    Parameters
    ----------
    steps : FilterSteps
        Run without the magnetometer, covariances wanted; these become the smoothed ones.
    first : int
        The step at whose end the filter had started.
    matrices, biases, sd_rad : ndarray, shapes (n + 1, 3, 3), (n + 1, 3) and (n + 1, 3)
        Filled, at the start of the stretch and at the end of each step.
    """
    n = steps.duration_s.shape[0]
    gain, predicted, wide = (
        np.empty((SMOOTHED, SMOOTHED)),
        np.empty((SMOOTHED, SMOOTHED)),
        np.empty((SMOOTHED, SMOOTHED)),
    )
    off, error, turn = np.empty(SMOOTHED), np.empty(SMOOTHED), np.empty((3, 3))
    velocity = steps.velocity[n - 1].copy()
    matrices[n], biases[n] = steps.matrix[n - 1], steps.bias[n - 1]
    for k in range(n - 2, first - 1, -1):
        _rauch(
            steps.transition[k + 1],
            steps.noise[k + 1],
            steps.covariance[k],
            steps.covariance[k + 1],
            gain,
            predicted,
            wide,
        )
        product_into(matrices[k + 2], steps.predicted[k + 1].T, turn)
        off[0], off[1], off[2] = vector_of(quaternion_from(turn))
        apply_into(turn, steps.predicted_velocity[k + 1], off[6:9])
        for i in range(3):
            off[3 + i] = biases[k + 2, i] - steps.bias[k, i]
            off[6 + i] = velocity[i] - off[6 + i]
        for i in range(SMOOTHED):
            total = 0.0
            for j in range(SMOOTHED):
                total += gain[j, i] * off[j]
            error[i] = total
        turn_into(error[0], error[1], error[2], turn)
        product_into(turn, steps.matrix[k], matrices[k + 1])
        apply_into(turn, steps.velocity[k], velocity)
        for i in range(3):
            biases[k + 1, i] = steps.bias[k, i] + error[3 + i]
            velocity[i] += error[6 + i]
    for k in range(first, n):
        for i in range(3):
            sd_rad[k + 1, i] = math.sqrt(max(steps.covariance[k, i, i], 0.0))
    for k in range(first, -1, -1):
        biases[k], sd_rad[k] = biases[k + 1], sd_rad[first + 1]
        matrices[k] = matrices[k + 1]
        if steps.resting[k] == 0.0:
            duration = steps.duration_s[k]
            turn_into(
                (steps.assumed_bias[k, 0] - biases[k, 0]) * duration,
                (steps.assumed_bias[k, 1] - biases[k, 1]) * duration,
                (steps.assumed_bias[k, 2] - biases[k, 2]) * duration,
                turn,
            )
            product_into(steps.turn[k], turn, turn)
            product_into(matrices[k + 1], turn.T, matrices[k])


@njit(cache=True, nogil=True, error_model="numpy")
def middles_of(
    steps: FilterSteps, matrices: FloatArray, biases: FloatArray, middles: FloatArray, rates: FloatArray
) -> None:
    """Fill the orientation in the middle of each step, (n, 3, 3), and the rate of turn without bias, (n,)."""
    turn = np.empty((3, 3))
    for k in range(steps.duration_s.shape[0]):
        x = steps.rate_rad_s[k, 0] - biases[k, 0]
        y = steps.rate_rad_s[k, 1] - biases[k, 1]
        z = steps.rate_rad_s[k, 2] - biases[k, 2]
        half = 0.5 * steps.duration_s[k]
        turn_into(half * x, half * y, half * z, turn)
        product_into(matrices[k], turn, middles[k])
        rates[k] = math.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True, error_model="numpy")
def smooth_heading(
    steps: FilterSteps,
    matrices: FloatArray,
    headings: FloatArray,
    variances: FloatArray,
    first_angle: float,
    start_variance: FloatArray,
    place_s: float,
    field_sd_rad: float,
    angles: FloatArray,
    angle_variances: FloatArray,
) -> None:
    """Smooth the angle about up that turns a smoothed stretch to north.

    Parameters
    ----------
    matrices : ndarray, shape (n + 1, 3, 3)
        The smoothed stretch.
    headings, variances : ndarray, shape (n,)
        North by the field at each step, and its variance; NaN where it is not trusted.
    first_angle : float
    start_variance : ndarray, shape (5,)
    angles, angle_variances : ndarray, shape (n + 1,)
        Filled.
    """
    n, size = steps.duration_s.shape[0], HEADING_STATES
    means, covariances = np.zeros((n + 1, size)), np.zeros((n + 1, size, size))
    transition, noise = np.eye(size), np.zeros(size)
    wide, gain, predicted = np.empty((size, size)), np.empty((size, size)), np.empty((size, size))
    one, off = np.empty(size), np.empty(size)
    means[0, 0] = first_angle
    for i in range(size):
        covariances[0, i, i] = start_variance[i]
    for k in range(n):
        x, p = means[k + 1], covariances[k + 1]
        _heading_model(k, steps, matrices[k], place_s, field_sd_rad, transition, noise)
        for i in range(size):
            x[i] = 0.0
            for j in range(size):
                x[i] += transition[i, j] * means[k, j]
                wide[i, j] = 0.0
                for m in range(size):
                    wide[i, j] += transition[i, m] * covariances[k, m, j]
        for i in range(size):
            for j in range(size):
                p[i, j] = noise[i] if i == j else 0.0
                for m in range(size):
                    p[i, j] += wide[i, m] * transition[j, m]
        if math.isnan(headings[k]):
            continue
        turned = headings[k] - (x[0] + x[4])
        turned -= 2.0 * math.pi * np.rint(turned / (2.0 * math.pi))
        total = p[0, 0] + p[0, 4] + p[4, 0] + p[4, 4] + variances[k]
        for i in range(size):
            one[i] = (p[i, 0] + p[i, 4]) / total
            x[i] += one[i] * turned
        for i in range(size):
            for j in range(size):
                wide[i, j] = p[i, j] - one[i] * (p[0, j] + p[4, j])
        for i in range(size):
            along = wide[i, 0] + wide[i, 4] - variances[k] * one[i]
            for j in range(size):
                p[i, j] = wide[i, j] - along * one[j]
    for k in range(n - 1, -1, -1):
        _heading_model(k, steps, matrices[k], place_s, field_sd_rad, transition, noise)
        for i in range(size):
            off[i] = means[k + 1, i]
            for j in range(size):
                off[i] -= transition[i, j] * means[k, j]
        _rauch(transition, noise, covariances[k], covariances[k + 1], gain, predicted, wide)
        for i in range(size):
            for j in range(size):
                means[k, i] += gain[j, i] * off[j]
    for k in range(n + 1):
        angles[k], angle_variances[k] = means[k, 0], covariances[k, 0, 0]


@njit(cache=True, nogil=True, error_model="numpy")
def _heading_model(
    k: int,
    steps: FilterSteps,
    matrix: FloatArray,
    place_s: float,
    field_sd_rad: float,
    transition: FloatArray,
    noise: FloatArray,
) -> None:
    duration = steps.duration_s[k]
    for i in range(3):
        transition[0, 1 + i] = 0.0 if steps.resting[k] > 0.0 else -matrix[2, i] * duration
        noise[1 + i] = steps.noise[k, 3 + i]
    transition[4, 4], noise[4] = 1.0, 0.0
    if steps.resting[k] == 0.0:
        transition[4, 4] = 1.0 - duration / place_s
        noise[4] = 2.0 * field_sd_rad * field_sd_rad / place_s * duration
    noise[0] = steps.noise[k, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def orient_samples(
    steps: FilterSteps, starts: FloatArray, biases: FloatArray, ends: FloatArray, xyzw: FloatArray
) -> None:
    """Fill the orientation of every sample, by the gyroscope from the start of its step.

    Parameters
    ----------
    starts, biases : ndarray, shapes (n, 3, 3) and (n, 3)
        At the start of each step.
    ends : ndarray, shape (n, 3, 3) or (0, 3, 3)
        At the end of each step: the error there is spread over the step. Empty: it is left.
    xyzw : ndarray, shape (m, 4)
    """
    first = 0
    for n in range(steps.duration_s.shape[0]):
        last = steps.last[n]
        start = quaternion_from(starts[n])
        x = steps.assumed_bias[n, 0] - biases[n, 0]
        y = steps.assumed_bias[n, 1] - biases[n, 1]
        z = steps.assumed_bias[n, 2] - biases[n, 2]
        for k in range(first, last):
            q = start
            if steps.resting[n] == 0.0:
                t, turns = steps.time_s[k], steps.turns_xyzw[k]
                turned = multiplied(
                    (turns[0], turns[1], turns[2], turns[3]), quaternion_of(x * t, y * t, z * t)
                )
                q = multiplied(start, turned)
            xyzw[k, 0], xyzw[k, 1], xyzw[k, 2], xyzw[k, 3] = q
        if ends.shape[0] > 0:
            end = xyzw[last - 1]
            back = (-end[0], -end[1], -end[2], end[3])
            x, y, z = vector_of(multiplied(quaternion_from(ends[n]), back))
            for k in range(first, last):
                share = steps.time_s[k] / steps.time_s[last - 1]
                spread = quaternion_of(share * x, share * y, share * z)
                row = xyzw[k]
                q = multiplied(spread, (row[0], row[1], row[2], row[3]))
                xyzw[k, 0], xyzw[k, 1], xyzw[k, 2], xyzw[k, 3] = q
        first = last
