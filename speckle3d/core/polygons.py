"""Which pixels of an image lie in a polygon."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.core.geometry import require_finite


def polygon_corners(corners: npt.ArrayLike, name: str) -> FloatArray:
    """Corners of a polygon, checked.

    Parameters
    ----------
    corners : array_like, shape (k, 2)
        At least three.
    name : str
        Of the corners, for the errors.

    Raises
    ------
    InvalidInputError
        If they are fewer, or not all finite.
    """
    found = np.asarray(corners, dtype=float)
    if found.ndim != 2 or found.shape[0] < 3 or found.shape[1] != 2:
        raise InvalidInputError(f"{name}: expected shape (k, 2) with k of 3 or more, got {found.shape}")
    require_finite(found, name)
    return found


def polygon_mask(shape: tuple[int, ...], corners: FloatArray) -> BoolArray:
    """Which pixels of an image are in a polygon, its sides included.

    Parameters
    ----------
    shape : tuple of int
        Columns and rows of the image.
    corners : ndarray, shape (k, 2)
        Corners (column, row) of any simple polygon; pixel centres are whole numbers.

    Returns
    -------
    ndarray of bool, shape (columns, rows)
    """
    draw = extra_module("skimage.draw", "calibrate", "a region")
    return np.asarray(draw.polygon2mask(shape, corners), dtype=bool)
