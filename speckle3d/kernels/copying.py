"""Copying arrays in kernels."""

from typing import Any

import numpy as np
import numpy.typing as npt
from numba.extending import register_jitable


@register_jitable(fastmath=False, error_model="numpy")
def copy_into(target: npt.NDArray[Any], source: npt.NDArray[Any]) -> None:
    """Copy an array into another of its shape.

    ``target[:] = source`` does the same, and compiles for seconds, for numba's words about its shape.
    """
    for place, value in np.ndenumerate(source):
        target[place] = value
