"""Curved reslices: a curve in the world, swept along one direction, flattened without stretching."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import make_interp_spline

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.imaging.cuts.planes import Cut, require_pixels

_DENSITY = 8
"""Points per pixel along the curve from which equal steps are read off: errors of a hundredth of a pixel."""


def curved_sheet(
    points_mm: FloatArray, down: FloatArray, height_mm: tuple[float, float], pixel_mm: float
) -> Cut:
    """Sweep a cubic spline through points along one direction.

    Columns of the sheet follow the curve as it is seen along `down`, in equal steps of arc length, so that
    lengths and angles on it are kept when it is laid flat; the curve's own rise and fall along `down` shows
    in the rows. On the axes, x counts from the first point, y from the first point as well.

    Parameters
    ----------
    points_mm : ndarray, shape (n, 3)
        In order, in the world; at least two.
    down : ndarray, shape (3,)
        Unit vector along the columns.
    height_mm : tuple of float
        Where columns begin and end along `down`, from the first point.
    pixel_mm : float

    Raises
    ------
    InvalidInputError
        If there are fewer than two points apart from each other as seen along `down`, or the sheet has more
        than `MAX_PIXELS` pixels.

    References
    ----------
    .. [1] A. Kanitsar et al., "CPR - curved planar reformation", IEEE Visualization, 2002.
    """
    flat = points_mm - ((points_mm - points_mm[:1]) @ down)[:, None] * down
    # A point picked twice is one.
    flat = flat[np.append(True, np.diff(_arc(flat)) > 1e-9)]
    if len(flat) < 2:
        raise InvalidInputError(
            "curve: expected at least two points apart from each other across the direction of its columns"
        )
    top, bottom = height_mm
    require_pixels(float(_arc(flat)[-1]), bottom - top, pixel_mm)
    base = _even_steps(flat, pixel_mm) + top * down
    return Cut(base, down, bottom - top, pixel_mm, (0.0, top))


def _even_steps(points_mm: FloatArray, step_mm: float) -> FloatArray:
    """Points of a spline in equal steps of its arc length, shape (n, 3); a shorter rest is left out."""
    chord = _arc(points_mm)
    dense = np.linspace(0.0, chord[-1], max(2, int(np.ceil(_DENSITY * chord[-1] / step_mm)) + 1))
    curve = make_interp_spline(chord, points_mm, k=min(3, len(points_mm) - 1))(dense)
    arc = _arc(curve)
    at = np.arange(int(arc[-1] / step_mm + 1e-9) + 1) * step_mm
    return np.column_stack([np.interp(at, arc, values) for values in curve.T])


def _arc(points_mm: FloatArray) -> FloatArray:
    """Length of a line through points up to each of them."""
    return np.append(0.0, np.linalg.norm(np.diff(points_mm, axis=0), axis=1).cumsum())
