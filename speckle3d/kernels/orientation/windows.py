"""Mean directions over windows of a gyroscope's readings, in axes that it carries along."""

import math

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.orientation.rotations import (
    AXES,
    compiled,
    product,
    quaternion_of,
    rotate,
    store,
    three,
)


@compiled
def window_sums(
    step_s: FloatArray, rate_rad_s: FloatArray, directions: FloatArray, width: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sum directions over windows of `width` samples, turned to each window's first axes.

    Parameters
    ----------
    step_s : ndarray, shape (m,)
        From each sample to the next.
    rate_rad_s : ndarray, shape (m, 3)
    directions : ndarray, shape (d, m, 3)
        Readings; rows that are not finite are left out.
    width : int

    Returns
    -------
    ndarray, shape (n, 4)
        Rotation from the next window's first axes to each one's, quaternions, scalar last.
    ndarray, shape (n, 3, 3)
        Mean over each window of the rotation from the sensor's axes to its first ones.
    ndarray, shape (d, n, 5)
        Sums of directions and of their lengths, and how many have one.
    """
    count = step_s.size // width
    turns, carried = np.empty((count, 4)), np.zeros((count, 3, 3))
    sums = np.zeros((directions.shape[0], count, 5))
    for n in range(count):
        q = (0.0, 0.0, 0.0, 1.0)
        for k in range(n * width, (n + 1) * width):
            for d in range(directions.shape[0]):
                x, y, z = three(directions[d, k])
                length = math.sqrt(x * x + y * y + z * z)
                if length > 0.0 and math.isfinite(length):
                    turned = rotate(q, (x, y, z))
                    for i in range(3):
                        sums[d, n, i] += turned[i]
                    sums[d, n, 3] += length
                    sums[d, n, 4] += 1.0
            for j, axis in enumerate(AXES):
                turned = rotate(q, axis)
                for i in range(3):
                    carried[n, i, j] += turned[i] / width
            dt = step_s[k]
            q = product(q, quaternion_of(dt * rate_rad_s[k, 0], dt * rate_rad_s[k, 1], dt * rate_rad_s[k, 2]))
        store(q, turns[n])
    return turns, carried, sums
