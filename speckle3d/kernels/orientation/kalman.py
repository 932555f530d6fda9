"""Prediction of the orientation filter's covariance, and Kalman's correction."""

from numba import njit

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.orientation.inclination_arrays import (
    BIAS,
    BIAS_WALK,
    CROSS,
    FORCE_NOISE,
    GAIN,
    GYRO_NOISE,
    GYRO_SCALE_NOISE,
    INNOVATION,
    LEVEL,
    NOISES,
    RESIDUAL,
    REST_NOISE,
    SHOWS,
    SIZE,
    SPEED,
    TRANSITION,
    TURNS,
    VECTOR,
    WIDE,
)
from speckle3d.kernels.orientation.rotations import (
    apply_into,
    product_into,
    solve_into,
    sparse_product_into,
    turn_into,
)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def predict_covariance(
    p: FloatArray,
    rate: float,
    bridged: float,
    shock: float,
    resting: bool,
    limits: FloatArray,
    duration: float,
    work: FloatArray,
) -> None:
    """Predict the covariance `p` over one increment by the transition in `work`; fill the noise there.

    `bridged` and `shock` are variances of angle, rad^2, and velocity, m^2/s^2, that the readings add.
    """
    f, wide = work[TRANSITION : TRANSITION + SIZE], work[WIDE : WIDE + SIZE]
    q, size = work[NOISES : NOISES + SIZE], p.shape[0]  # not unrolled
    turning = limits[GYRO_NOISE] * limits[GYRO_NOISE] + (limits[GYRO_SCALE_NOISE] * rate) ** 2
    if resting:
        turning = (limits[REST_NOISE] * limits[GYRO_NOISE]) ** 2
    walk = limits[BIAS_WALK] * limits[BIAS_WALK] * duration
    for i in range(3):
        q[i, i] = turning * duration + bridged
        q[i + 3, i + 3] = walk
        q[i + 6, i + 6] = limits[FORCE_NOISE] * limits[FORCE_NOISE] * duration + shock
    for i in range(size):
        for j in range(size):
            wide[i, j] = f[i, i] * p[i, j]
        for k in range(size):
            factor = f[i, k]
            if k != i and factor != 0.0:
                for j in range(size):
                    wide[i, j] += factor * p[k, j]
    for i in range(size):
        for j in range(size):
            p[i, j] = q[i, j] + f[j, j] * wide[i, j]
    for j in range(size):
        for k in range(size):
            factor = f[j, k]
            if k != j and factor != 0.0:
                for i in range(size):
                    p[i, j] += factor * wide[i, k]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def update(
    variance: float, s: FloatArray, p: FloatArray, by_speed: bool, heading_apart: bool, work: FloatArray
) -> None:
    """Kalman's correction (Joseph's form) by the three residuals in `work`.

    A velocity tells nothing of turning about up: its own direction turns as likely. So neither heading nor
    the bias about up is corrected by it, and their errors count as noise (Schmidt). A heading that is found
    elsewhere is corrected by nothing.
    """
    size = p.shape[0]  # not unrolled
    shows, cross, gain = work[SHOWS : SHOWS + 3], work[CROSS : CROSS + 3], work[GAIN : GAIN + 3]
    wide, innovation = work[WIDE : WIDE + SIZE], work[INNOVATION : INNOVATION + 3]
    sparse_product_into(shows, p, cross)
    for r in range(3):
        for t in range(3):
            total = variance if r == t else 0.0
            for k in range(size):
                total += cross[r, k] * shows[t, k]
            innovation[r, t] = total
        for j in range(size):
            gain[r, j] = cross[r, j]
    solve_into(innovation, gain)
    for r in range(3):
        if by_speed or heading_apart:
            gain[r, 2] = 0.0
        if by_speed:
            about_up = 0.0
            for i in range(3):
                about_up += s[LEVEL + 6 + i] * gain[r, 3 + i]
            for i in range(3):
                gain[r, 3 + i] -= about_up * s[LEVEL + 6 + i]
    for i in range(size):
        for j in range(size):
            total = p[i, j]
            for r in range(3):
                total -= gain[r, i] * cross[r, j]
            wide[i, j] = total
    for i in range(size):
        for r in range(3):
            total = -variance * gain[r, i]
            for k in range(size):
                total += wide[i, k] * shows[r, k]
            cross[r, i] = total
    for i in range(size):
        for j in range(size):
            total = wide[i, j]
            for r in range(3):
                total -= cross[r, i] * gain[r, j]
            p[i, j] = total
    _inject(s, work)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _inject(s: FloatArray, work: FloatArray) -> None:
    """Apply the estimated error to the state."""
    error, turn = work[VECTOR], work[TURNS]
    level, speed = s[LEVEL : LEVEL + 9], s[SPEED : SPEED + 3]
    for j in range(SIZE):
        error[j] = 0.0
        for r in range(3):
            error[j] += work[GAIN + r, j] * work[RESIDUAL, r]
    turn_into(error[0], error[1], error[2], turn)
    product_into(turn, level, level)
    apply_into(turn, speed, speed)
    for i in range(3):
        speed[i] += error[6 + i]
        s[BIAS + i] += error[3 + i]
