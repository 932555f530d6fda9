"""Array types by their elements; shapes are in docstrings.

Written out, since files are read by them: NumPy 2.5 hides the element within `numpy.typing.NDArray`.
"""

from typing import Any, TypeVar

import numpy as np

_Element = TypeVar("_Element", bound=np.generic)
_Array = np.ndarray[tuple[Any, ...], np.dtype[_Element]]

FloatArray = _Array[np.float64]
Float32Array = _Array[np.float32]
Float16Array = _Array[np.float16]
IntArray = _Array[np.int64]
BoolArray = _Array[np.bool_]
ByteArray = _Array[np.uint8]
ComplexArray = _Array[np.complex128]
Complex64Array = _Array[np.complex64]
AnyArray = _Array[Any]
