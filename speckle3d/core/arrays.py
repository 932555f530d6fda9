"""Array types by their elements; shapes are in docstrings.

Written out, since files are read by them: NumPy 2.5 hides the element within `numpy.typing.NDArray`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

FloatArray = np.ndarray[tuple[Any, ...], np.dtype[np.float64]]
Float32Array = np.ndarray[tuple[Any, ...], np.dtype[np.float32]]
Float16Array = np.ndarray[tuple[Any, ...], np.dtype[np.float16]]
IntArray = np.ndarray[tuple[Any, ...], np.dtype[np.int64]]
BoolArray = np.ndarray[tuple[Any, ...], np.dtype[np.bool_]]
ByteArray = np.ndarray[tuple[Any, ...], np.dtype[np.uint8]]
ComplexArray = np.ndarray[tuple[Any, ...], np.dtype[np.complex128]]
Complex64Array = np.ndarray[tuple[Any, ...], np.dtype[np.complex64]]
AnyArray = np.ndarray[tuple[Any, ...], np.dtype[Any]]
