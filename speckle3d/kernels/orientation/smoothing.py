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
    invert,
    matrix_product,
    product,
    quaternion,
    quaternion_of,
    rotate,
    three,
    transported,
    turn_by,
    vector_of,
)


@compiled
def turn_about_up(angles_rad: FloatArray, xyzw: FloatArray) -> FloatArray:
    """Quaternions, shape (m, 4), turned about up."""
    out = np.empty_like(xyzw)
    for k in range(xyzw.shape[0]):
        out[k] = product(quaternion_of(0.0, 0.0, angles_rad[k]), quaternion(xyzw[k]))
    return out


@compiled
def rotate_rows(xyzw: FloatArray, vectors: FloatArray) -> FloatArray:
    """Vectors, shape (m, 3), each turned by a quaternion."""
    out = np.empty_like(vectors)
    for k in range(vectors.shape[0]):
        out[k] = rotate(quaternion(xyzw[k]), three(vectors[k]))
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
    levels[n], biases[n] = steps[n - 1].level, steps[n - 1].bias
    speed, off = steps[n - 1].speed.copy(), np.empty(SIZE)
    for k in range(n - 2, first - 1, -1):
        step, after, f, p = steps[k], steps[k + 1], transition[k + 1], covariance[k]
        forecast = transported(f, p)
        for i in range(SIZE):
            forecast[i, i] += after.noise[i]
        gain: Any = np.linalg.solve(forecast, matrix_product(f, p)).T
        covariance[k] = p + transported(gain, covariance[k + 1] - forecast)
        turn = product(quaternion(levels[k + 2]), invert(quaternion(after.predicted)))
        off[:3] = vector_of(turn)
        off[3:6] = biases[k + 2] - step.bias
        off[6:] = speed
        off[6:] -= np.array(rotate(turn, three(after.predicted_speed)))
        error = np.zeros(SIZE)
        add_product(error, gain, off)
        turn = quaternion_of(error[0], error[1], error[2])
        levels[k + 1] = product(turn, quaternion(step.level))
        biases[k + 1] = step.bias + error[BIAS:SPEED]
        speed[:] = rotate(turn, three(step.speed))
        speed += error[SPEED:]
    for k in range(first, -1, -1):
        step = steps[k]
        biases[k], levels[k] = biases[k + 1], levels[k + 1]
        if not step.resting:
            turn = product(quaternion(step.turn), turn_by(step.start_bias, biases[k], step.duration_s))
            levels[k] = product(quaternion(levels[k + 1]), invert(turn))


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
        q, span_s, last = quaternion(nodes[n]), 0.0, steps[n].last
        for k in range(first, last):
            if not steps[n].resting:
                q = product(q, turn_by(rate_rad_s[k], biases[n], step_s[k]))
            xyzw[k] = q
        x, y, z = vector_of(product(quaternion(nodes[n + 1]), invert(q)))
        whole_s = step_s[first:last].sum()
        for k in range(first, last):
            span_s += step_s[k]
            share = span_s / whole_s
            xyzw[k] = product(quaternion_of(share * x, share * y, share * z), quaternion(xyzw[k]))
        first = last
