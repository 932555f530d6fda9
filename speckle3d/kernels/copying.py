"""Copying arrays in kernels."""

from __future__ import annotations

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def copy_into(target: FloatArray, source: FloatArray) -> None:
    """Copy an array into another of its shape.

    ``target[:] = source`` does the same, and compiles for seconds, for numba's words about its shape.
    """
    for place, value in np.ndenumerate(source):
        target[place] = value
