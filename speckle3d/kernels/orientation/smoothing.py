"""Smooth the increments of a stretch backward, and orient its samples between them.

References
----------
.. [1] H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA
   J., 1965.
"""

from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.orientation.inclination import BIAS, SIZE, SPEED
from speckle3d.kernels.orientation.rotations import (
    add_product,
    compiled,
    difference,
    inverse,
    invert,
    product,
    quaternion,
    quaternion_of,
    rotate,
    store,
    subtract_product,
    three,
    times_transpose,
    turn_by,
    vector_of,
)


@compiled
def turn_about_up(angles_rad: FloatArray, xyzw: FloatArray) -> FloatArray:
    """Quaternions, shape (m, 4), turned about up."""
    out = np.empty_like(xyzw)
    for k in range(xyzw.shape[0]):
        store(product(quaternion_of(0.0, 0.0, angles_rad[k]), quaternion(xyzw[k])), out[k])
    return out


@compiled
def rotate_rows(xyzw: FloatArray, vectors: FloatArray) -> FloatArray:
    """Vectors, shape (m, 3), each turned by a quaternion."""
    out = np.empty_like(vectors)
    for k in range(vectors.shape[0]):
        store(rotate(quaternion(xyzw[k]), three(vectors[k])), out[k])
    return out


@compiled
def smooth_steps(
    steps: Any,
    covariance: FloatArray,
    transition: FloatArray,
    first: int,
    levels: FloatArray,
    biases: FloatArray,
) -> None:
    """Smooth the steps from `first` on [1]_; before it, go back by the gyroscope.

    Parameters
    ----------
    steps : structured ndarray, shape (n,), of `STEP`
    covariance, transition : ndarray, shape (n, 9, 9)
        The covariances become the smoothed ones.
    first : int
        The step at whose end the filter had started.
    levels, biases : ndarray, shapes (n + 1, 4) and (n + 1, 3)
        Filled, at the start of the stretch and at the end of each step.
    """
    n = steps.shape[0]
    store(steps[n - 1].level, levels[n])
    store(steps[n - 1].bias, biases[n])
    speed, off = np.empty(3), np.empty(SIZE)
    store(steps[n - 1].speed, speed)
    for k in range(n - 2, first - 1, -1):
        step, after, f, p = steps[k], steps[k + 1], transition[k + 1], covariance[k]
        forecast = times_transpose(f, times_transpose(f, p))
        for i in range(SIZE):
            forecast[i, i] += after.noise[i]
        gain = times_transpose(times_transpose(p, f), inverse(forecast, 0.0)[0])
        for i in range(SIZE):
            for j in range(SIZE):
                forecast[i, j] -= covariance[k + 1, i, j]
        subtract_product(p, times_transpose(gain, forecast), gain)
        turn = product(quaternion(levels[k + 2]), invert(quaternion(after.predicted)))
        store(vector_of(turn), off)
        store(difference(biases[k + 2], step.bias), off[BIAS:])
        store(difference(speed, rotate(turn, three(after.predicted_speed))), off[SPEED:])
        error = np.zeros(SIZE)
        add_product(error, gain, off)
        turn = quaternion_of(error[0], error[1], error[2])
        store(product(turn, quaternion(step.level)), levels[k + 1])
        store(rotate(turn, three(step.speed)), speed)
        for i in range(3):
            speed[i] += error[SPEED + i]
            biases[k + 1, i] = step.bias[i] + error[BIAS + i]
    for k in range(first, -1, -1):
        step = steps[k]
        store(biases[k + 1], biases[k])
        store(levels[k + 1], levels[k])
        if not step.resting:
            turn = product(quaternion(step.turn), turn_by(step.start_bias, biases[k], step.duration_s))
            store(product(quaternion(levels[k + 1]), invert(turn)), levels[k])


@compiled
def orient_samples(
    step_s: FloatArray,
    rate_rad_s: FloatArray,
    steps: Any,
    nodes: FloatArray,
    biases: FloatArray,
    xyzw: FloatArray,
) -> None:
    """Fill the orientation of every sample, by the gyroscope, whose error is spread over each step.

    Parameters
    ----------
    step_s, rate_rad_s : ndarray, shapes (m,) and (m, 3)
    steps : structured ndarray, shape (n,), of `STEP`
        At rest the sensor stays at a step's start.
    nodes : ndarray, shape (n + 1, 4)
        At the start and at the end of each step.
    biases : ndarray, shape (n + 1, 3)
    xyzw : ndarray, shape (m, 4)
    """
    first = 0
    for n in range(steps.shape[0]):
        q, whole_s, span_s, last = quaternion(nodes[n]), 0.0, 0.0, steps[n].last
        for k in range(first, last):
            if not steps[n].resting:
                q = product(q, turn_by(rate_rad_s[k], biases[n], step_s[k]))
            store(q, xyzw[k])
            whole_s += step_s[k]
        x, y, z = vector_of(product(quaternion(nodes[n + 1]), invert(q)))
        for k in range(first, last):
            span_s += step_s[k]
            share = span_s / whole_s
            turn = quaternion_of(share * x, share * y, share * z)
            store(product(turn, quaternion(xyzw[k])), xyzw[k])
        first = last
