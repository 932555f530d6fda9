"""Smoothing an orientation backward: a loop over steps, laid out in `inclination_arrays`.

References
----------
.. [1] H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA
   J., 1965.
"""

import math

from numba import njit

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.orientation.inclination_arrays import (
    DURATION,
    MATRIX,
    NOISE,
    PREDICTED,
    PREDICTED_SPEED,
    RESTED,
    SIZE,
    STEP_BIAS,
    STEP_SPEED,
    TURN,
)
from speckle3d.kernels.orientation.increments import rate_beyond
from speckle3d.kernels.orientation.rotations import (
    apply_into,
    back_product_into,
    product_into,
    quaternion_from,
    solve_into,
    sparse_product_into,
    turn_into,
    vector_of,
)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _rauch(
    transition: FloatArray,
    noise: FloatArray,
    covariance: FloatArray,
    after: FloatArray,
    gain: FloatArray,
    predicted: FloatArray,
    wide: FloatArray,
) -> None:
    """One step back, as in [1]_: fill the gain's transpose, smooth the covariance in place.

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
    sparse_product_into(transition, covariance, wide)
    for i in range(size):
        for j in range(size):
            total = noise[i] if i == j else 0.0
            for k in range(size):
                total += wide[i, k] * transition[j, k]
            predicted[i, j] = total
            gain[i, j] = wide[i, j]
    for i in range(size):
        for j in range(size):
            wide[i, j] = predicted[i, j]
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


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _correct(
    step: FloatArray,
    after: FloatArray,
    gain: FloatArray,
    matrices: FloatArray,
    biases: FloatArray,
    velocity: FloatArray,
    work: FloatArray,
) -> None:
    """Correct a step's state by how far the next one's smoothed state is from that predicted.

    Parameters
    ----------
    step, after : ndarray, shape (STEP,)
        This step and the next.
    gain : ndarray, shape (9, 9)
        Transposed.
    matrices, biases, velocity : ndarray, shapes (2, 9), (2, 3) and (9,)
        Smoothed at the ends of this step, filled, and of the next; of `velocity` the first three count, the
        next one's before and this one's after.
    work : ndarray, shape (3, 9)
        Buffers.
    """
    off, error, turn = work[0], work[1], work[2]
    back_product_into(matrices[1], after[PREDICTED : PREDICTED + 9], turn)
    off[0], off[1], off[2] = vector_of(quaternion_from(turn))
    apply_into(turn, after[PREDICTED_SPEED : PREDICTED_SPEED + 3], off[6:9])
    for i in range(3):
        off[3 + i] = biases[1, i] - step[STEP_BIAS + i]
        off[6 + i] = velocity[i] - off[6 + i]
    for i in range(SIZE):
        total = 0.0
        for j in range(SIZE):
            total += gain[j, i] * off[j]
        error[i] = total
    turn_into(error[0], error[1], error[2], turn)
    product_into(turn, step[MATRIX : MATRIX + 9], matrices[0])
    apply_into(turn, step[STEP_SPEED : STEP_SPEED + 3], velocity)
    for i in range(3):
        biases[0, i] = step[STEP_BIAS + i] + error[3 + i]
        velocity[i] += error[6 + i]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def smooth_steps(
    steps: FloatArray,
    covariance: FloatArray,
    transition: FloatArray,
    first: int,
    matrices: FloatArray,
    biases: FloatArray,
    sd_rad: FloatArray,
    work: FloatArray,
) -> None:
    """Smooth the steps from `first` on; before it, go back by the gyroscope.

    Parameters
    ----------
    steps : ndarray, shape (n, STEP)
        As the filter left them.
    covariance, transition : ndarray, shape (n, 9, 9)
        The covariances become the smoothed ones.
    first : int
        The step at whose end the filter had started.
    matrices, biases, sd_rad : ndarray, shapes (n + 1, 9), (n + 1, 3) and (n + 1, 3)
        Filled, at the start of the stretch and at the end of each step.
    work : ndarray, shape (31, 9)
        Buffers.
    """
    n = steps.shape[0]
    wide, gain, predicted = work[:SIZE], work[SIZE : 2 * SIZE], work[2 * SIZE : 3 * SIZE]
    turn, velocity = work[29], work[30]
    last = steps[n - 1]
    for i in range(9):
        matrices[n, i] = last[MATRIX + i]
    for i in range(3):
        biases[n, i], velocity[i] = last[STEP_BIAS + i], last[STEP_SPEED + i]
    for k in range(n - 2, first - 1, -1):
        step, after = steps[k], steps[k + 1]
        noise = after[NOISE : NOISE + SIZE]
        _rauch(transition[k + 1], noise, covariance[k], covariance[k + 1], gain, predicted, wide)
        _correct(step, after, gain, matrices[k + 1 : k + 3], biases[k + 1 : k + 3], velocity, work[27:30])
    for k in range(first, n):
        for i in range(3):
            sd_rad[k + 1, i] = math.sqrt(max(covariance[k, i, i], 0.0))
    for k in range(first, -1, -1):
        step = steps[k]
        for i in range(3):
            biases[k, i], sd_rad[k, i] = biases[k + 1, i], sd_rad[first + 1, i]
        for i in range(9):
            matrices[k, i] = matrices[k + 1, i]
        if step[RESTED] == 0.0:
            x, y, z = rate_beyond(step, biases[k])
            turn_into(x * step[DURATION], y * step[DURATION], z * step[DURATION], turn)
            product_into(step[TURN : TURN + 9], turn, turn)
            back_product_into(matrices[k + 1], turn, matrices[k])
