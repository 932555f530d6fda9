"""Curved reslices: a curve in the world, swept along one direction, flattened without stretching."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import make_interp_spline

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.imaging.cuts.planes import DEFAULT_PIXEL_MM, Cut, require_pixels

_DENSITY = 8
"""Points per pixel along the curve from which equal steps are read off: errors of a hundredth of a pixel."""


@dataclass(frozen=True)
class CurvedSheet(Cut):
    """A sheet that runs down from a curve, and the pixels it is cut into.

    Its columns are straight; neighbours are one pixel apart. Laid flat, lengths and angles on it are kept.

    Parameters
    ----------
    base_mm : ndarray, shape (columns, 3)
        Centre of every column's first pixel, in the world; all in one plane across `down`.
    down : ndarray, shape (3,)
        Unit vector along which columns run.
    height_mm, pixel_mm : float
    first_mm : tuple of float
        What the axes of a picture say at the centre of the first pixel: x and y.
    """

    base_mm: FloatArray
    down: FloatArray
    height_mm: float
    pixel_mm: float
    first_mm: tuple[float, float] = (0.0, 0.0)

    @property
    def width_mm(self) -> float:
        """Distance between the first and the last column along the sheet."""
        return (len(self.base_mm) - 1) * self.pixel_mm

    def world_from_mm(self, x_mm: npt.ArrayLike, y_mm: npt.ArrayLike) -> FloatArray:
        """Points of the world by what the picture's axes say, shape (..., 3), mm; NaN beyond the ends."""
        x, y = np.broadcast_arrays(np.asarray(x_mm, dtype=float), np.asarray(y_mm, dtype=float))
        column = (x - self.first_mm[0]) / self.pixel_mm
        columns = np.arange(len(self.base_mm))
        base = [np.interp(column, columns, values, np.nan, np.nan) for values in self.base_mm.T]
        return np.stack(base, axis=-1) + (y - self.first_mm[1])[..., None] * self.down


def curved_sheet(
    points_mm: npt.ArrayLike,
    down: npt.ArrayLike,
    height_mm: tuple[float, float],
    pixel_mm: float = DEFAULT_PIXEL_MM,
    smooth: bool = True,
) -> CurvedSheet:
    """Sweep a curve through points along one direction.

    Columns of the sheet follow the curve as it is seen along `down`, in equal steps of arc length; the
    curve's own rise and fall along `down` shows in the rows. On the axes, x counts from the first point, y
    from the first point as well.

    Parameters
    ----------
    points_mm : array_like, shape (n, 3)
        In order, in the world; at least two.
    down : array_like, shape (3,)
        Direction of the columns.
    height_mm : tuple of float
        Where columns begin and end along `down`, from the first point.
    pixel_mm : float
    smooth : bool
        Join the points by a cubic spline rather than by straight lines.

    Raises
    ------
    InvalidInputError
        If there are fewer than two points apart from each other as seen along `down`, or the sheet has more
        than `MAX_PIXELS` pixels.

    References
    ----------
    .. [1] A. Kanitsar et al., "CPR - curved planar reformation", IEEE Visualization, 2002.
    """
    points, axis = np.asarray(points_mm, dtype=float), np.asarray(down, dtype=float)
    length = float(np.linalg.norm(axis))
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all() or not 0 < length < np.inf:
        raise InvalidInputError(
            "curve: expected finite points of x, y, z in mm and a direction of its columns, got shape "
            f"{points.shape} and {axis.tolist()}"
        )
    axis = axis / length
    flat = points - ((points - points[:1]) @ axis)[:, None] * axis
    # A point picked twice is one.
    flat = flat[np.append(True, np.diff(_arc(flat)) > 1e-9)]
    if len(flat) < 2:
        raise InvalidInputError(
            "curve: expected at least two points apart from each other across the direction of its columns"
        )
    top, bottom = height_mm
    require_pixels(float(_arc(flat)[-1]), bottom - top, pixel_mm)
    base = _even_steps(flat, pixel_mm, smooth) + top * axis
    return CurvedSheet(base, axis, bottom - top, pixel_mm, (0.0, top))


def _even_steps(points_mm: FloatArray, step_mm: float, smooth: bool) -> FloatArray:
    """Points of a curve in equal steps of its arc length, shape (n, 3); a shorter rest is left out."""
    chord = _arc(points_mm)
    dense = np.linspace(0.0, chord[-1], max(2, int(np.ceil(_DENSITY * chord[-1] / step_mm)) + 1))
    # With the points' own places among them, straight lines keep their corners.
    dense = np.union1d(dense, chord)
    curve = make_interp_spline(chord, points_mm, k=min(3, len(points_mm) - 1) if smooth else 1)(dense)
    arc = _arc(curve)
    at = np.arange(int(arc[-1] / step_mm + 1e-9) + 1) * step_mm
    return np.column_stack([np.interp(at, arc, values) for values in curve.T])


def _arc(points_mm: FloatArray) -> FloatArray:
    """Length of a line through points up to each of them."""
    return np.append(0.0, np.linalg.norm(np.diff(points_mm, axis=0), axis=1).cumsum())
