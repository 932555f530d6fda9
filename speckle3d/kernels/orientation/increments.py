"""Samples summed to the steps of the orientation filter, and the orientation of samples within its steps.

A step sums the turn and the turned specific force of its samples, each with the attitude in the middle of the
sample's interval, so that the filter may run more slowly than the sensor without losing coning and sculling
motion [1]_.

References
----------
.. [1] P. G. Savage, "Strapdown inertial navigation integration algorithm design", J. Guid. Control
   Dyn., 1998.
"""

import math

from numba import njit

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.kernels.orientation.inclination_arrays import (
    ASSUMED,
    BRIDGED,
    DURATION,
    FIELD,
    FORCE,
    RATE,
    RESTED,
    SAMPLE_S,
    TURN,
)
from speckle3d.kernels.orientation.rotations import (
    matrix_into,
    multiplied,
    quaternion_from,
    quaternion_of,
    vector_of,
)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def sum_samples(
    step_s: FloatArray,
    rate: FloatArray,
    force: FloatArray,
    field: FloatArray,
    first: int,
    last: int,
    longest_s: float,
    before: FloatArray,
    step: FloatArray,
    within: FloatArray,
) -> None:
    """Sum the samples of one increment, with the bias that `step` holds.

    Parameters
    ----------
    step_s : ndarray, shape (m,)
    rate, force, field : ndarray, shape (m, 3)
    first, last : int
        Its samples: from `first` to before `last`.
    longest_s : float
        Longest step without a loss: over a longer one the rate may change as much as it did from the sample
        before to the one after.
    before : ndarray, shape (3,)
        Rate of the sample before, NaN if there is none; becomes that of the last.
    step : ndarray, shape (STEP,)
        Filled up to the turn, and the integral of the specific force.
    within : ndarray, shape (m, SAMPLE)
        Its rows are filled.
    """
    turn = step[TURN : TURN + 9]
    q = (0.0, 0.0, 0.0, 1.0)
    duration, fields = 0.0, 0
    step[BRIDGED] = 0.0
    for i in range(3):
        step[RATE + i] = step[FIELD + i] = step[FORCE + i] = 0.0
    for k in range(first, last):
        dt = step_s[k]
        for i in range(3):
            if dt > longest_s and math.isfinite(before[i]):
                step[BRIDGED] += (dt * (rate[k, i] - before[i])) ** 2
            before[i] = rate[k, i]
        x, y = (rate[k, 0] - step[ASSUMED]) * dt, (rate[k, 1] - step[ASSUMED + 1]) * dt
        z = (rate[k, 2] - step[ASSUMED + 2]) * dt
        q = multiplied(q, quaternion_of(x, y, z))
        matrix_into(multiplied(q, quaternion_of(-0.5 * x, -0.5 * y, -0.5 * z)), turn)
        for i in range(3):
            a, b, c = turn[3 * i], turn[3 * i + 1], turn[3 * i + 2]
            step[FORCE + i] += dt * (a * force[k, 0] + b * force[k, 1] + c * force[k, 2])
            step[RATE + i] += dt * rate[k, i]
        matrix_into(q, turn)
        if math.isfinite(field[k, 0]) and math.isfinite(field[k, 1]) and math.isfinite(field[k, 2]):
            fields += 1
            for i in range(3):
                a, b, c = turn[3 * i], turn[3 * i + 1], turn[3 * i + 2]
                step[FIELD + i] += a * field[k, 0] + b * field[k, 1] + c * field[k, 2]
        duration += dt
        within[k, 0], within[k, 1], within[k, 2], within[k, 3] = q
        within[k, SAMPLE_S] = duration
    step[DURATION] = duration
    for i in range(3):
        step[RATE + i] /= duration
        step[FIELD + i] = step[FIELD + i] / fields if fields > 0 else math.nan


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def rate_beyond(step: FloatArray, bias: FloatArray) -> tuple[float, float, float]:
    """Rate, rad/s, that a step's turn lacks if the bias is this one, not the one it was summed with."""
    return step[ASSUMED] - bias[0], step[ASSUMED + 1] - bias[1], step[ASSUMED + 2] - bias[2]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def orient_samples(
    last: IntArray,
    steps: FloatArray,
    within: FloatArray,
    starts: FloatArray,
    biases: FloatArray,
    ends: FloatArray,
    xyzw: FloatArray,
) -> None:
    """Fill the orientation of every sample, by the gyroscope from the start of its step.

    Parameters
    ----------
    last : ndarray of int, shape (n,)
        Sample after each step's last.
    steps, within : ndarray, shapes (n, STEP) and (m, SAMPLE)
        As the filter left them.
    starts, biases : ndarray, shapes (n, 9) and (n, 3)
        At the start of each step.
    ends : ndarray, shape (n, 9) or (0, 9)
        At the end of each step: the error there is spread over the step. Empty: it is left.
    xyzw : ndarray, shape (m, 4)
    """
    first = 0
    for n in range(last.shape[0]):
        step, end = steps[n], last[n]
        start = quaternion_from(starts[n])
        x, y, z = rate_beyond(step, biases[n])
        for k in range(first, end):
            q = start
            if step[RESTED] == 0.0:
                t = within[k, SAMPLE_S]
                turned = (within[k, 0], within[k, 1], within[k, 2], within[k, 3])
                q = multiplied(start, multiplied(turned, quaternion_of(x * t, y * t, z * t)))
            xyzw[k, 0], xyzw[k, 1], xyzw[k, 2], xyzw[k, 3] = q
        if ends.shape[0] > 0:
            back = (-xyzw[end - 1, 0], -xyzw[end - 1, 1], -xyzw[end - 1, 2], xyzw[end - 1, 3])
            x, y, z = vector_of(multiplied(quaternion_from(ends[n]), back))
            for k in range(first, end):
                share = within[k, SAMPLE_S] / within[end - 1, SAMPLE_S]
                q = (xyzw[k, 0], xyzw[k, 1], xyzw[k, 2], xyzw[k, 3])
                q = multiplied(quaternion_of(share * x, share * y, share * z), q)
                xyzw[k, 0], xyzw[k, 1], xyzw[k, 2], xyzw[k, 3] = q
        first = end
