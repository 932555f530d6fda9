"""Filling empty voxels from the measured ones nearby."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ByteArray, Float32Array, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.threads import in_parallel

MAX_RADIUS = 255
"""Largest half edge of a box, to catch wrong units, and within what counts of four bytes hold."""

_PLANES_AT_ONCE = 2
"""Fewer are not worth a thread's while."""


def fill_holes(
    voxels: Float32Array,
    state: ByteArray,
    radius: int | npt.ArrayLike,
    first: int = 0,
    stop: int | None = None,
) -> None:
    """Fill empty voxels from measured ones within a radius; these are never changed.

    An empty voxel becomes the mean of the measured voxels in the smallest box around it that holds any, and
    is marked as filled. Filled voxels fill no others, so that a second call changes nothing, and a slab's
    planes come out as those of the whole volume if the slab has `radius` planes more on either side.

    Parameters
    ----------
    voxels : ndarray of float32, shape (n_k, n_j, n_i), changed in place
        What empty ones hold does not matter.
    state : ndarray of uint8, shape (n_k, n_j, n_i), changed in place
        `EMPTY`, `MEASURED` or `FILLED` of `speckle3d.core.labels`.
    radius : int, or array_like of int, shape (n, 3)
        Half the edge of the largest box in voxels: boxes are cubes that grow by one voxel to every side;
        with 0 nothing is filled. Or half edges (k, j, i) of each box, smallest first: see `boxes_within`.
    first, stop : int
        Planes along k to fill; by default all.

    Raises
    ------
    InvalidInputError
        If the arrays or the radius are not what they must be.

    Examples
    --------
    >>> voxels = np.array([[[10.0, 0.0, 0.0, 0.0, 30.0]]], np.float32)
    >>> state = np.array([[[1, 0, 0, 0, 1]]], np.uint8)
    >>> fill_holes(voxels, state, radius=2)
    >>> voxels[0, 0].tolist(), state[0, 0].tolist()
    ([10.0, 10.0, 20.0, 30.0, 30.0], [1, 2, 2, 2, 1])
    """
    from speckle3d.kernels.holes import fill_planes

    stop = voxels.shape[0] if stop is None else stop
    boxes = _checked_boxes(radius)
    _require_arrays(voxels, state, first, stop)
    if len(boxes) > 0:
        in_parallel(
            lambda low, high: fill_planes(voxels, state, boxes, first + low, first + high),
            stop - first,
            _PLANES_AT_ONCE,
        )


def cubes_within(radius: int) -> IntArray:
    """Cubes that grow by a voxel to every side: half edges along k, j and i, shape (radius, 3)."""
    return np.repeat(np.arange(1, radius + 1), 3).reshape(-1, 3)


def boxes_within(radius_mm: float, spacing_mm: tuple[float, float, float]) -> IntArray:
    """Boxes that grow evenly in mm, for voxels of any shape: what `fill_holes` tries in turn.

    Parameters
    ----------
    radius_mm : float
        Distance along each axis to the centres of the farthest voxels that count.
    spacing_mm : tuple of float
        Along i, j and k.

    Returns
    -------
    ndarray of int64, shape (n, 3)
        Half edges along k, j and i, in voxels, smallest box first.

    Raises
    ------
    InvalidInputError
        If the radius is negative or not finite, or larger than `MAX_RADIUS` voxels.

    Examples
    --------
    >>> boxes_within(1.0, (0.4, 0.4, 1.0)).tolist()
    [[0, 1, 1], [0, 2, 2], [1, 2, 2]]
    """
    if not 0.0 <= radius_mm <= MAX_RADIUS * min(spacing_mm):
        raise InvalidInputError(
            f"radius_mm: expected 0 to {MAX_RADIUS} voxels of {min(spacing_mm):g} mm, got {radius_mm:g} mm"
        )
    spacing = np.array(spacing_mm, dtype=float)[::-1]
    # A hair more, so that rounding does not leave a voxel out that lies right at the radius.
    most = np.floor(radius_mm / spacing * (1 + 1e-9)).astype(int)
    reached = [step * np.arange(1, n + 1) for step, n in zip(spacing, most, strict=True)]
    radii = np.unique(np.concatenate(reached))
    half_edges = np.floor(radii[:, None] / spacing * (1 + 1e-9)).astype(np.int64)
    return np.asarray(np.unique(half_edges, axis=0).reshape(-1, 3))


def _checked_boxes(radius: int | npt.ArrayLike) -> IntArray:
    given = np.asarray(radius)
    if given.dtype.kind not in "iu" or (given.ndim > 0 and given.shape[1:] != (3,)):
        raise InvalidInputError(
            f"radius: expected a number of voxels, or boxes of shape (n, 3), got {radius!r}"
        )
    boxes = np.asarray(given, dtype=np.int64)
    if given.size > 0 and not 0 <= given.min() <= given.max() <= MAX_RADIUS:
        worst = given.min() if given.min() < 0 else given.max()
        raise InvalidInputError(f"radius: expected 0 to {MAX_RADIUS} voxels, got {worst}")
    if given.ndim == 0:
        return cubes_within(int(given))
    if (np.diff(boxes, axis=0) < 0).any():
        raise InvalidInputError("radius: expected boxes each at least as large as the one before")
    return np.ascontiguousarray(boxes)


def _require_arrays(voxels: Float32Array, state: ByteArray, first: int, stop: int) -> None:
    for name, array, kind in (("voxels", voxels, np.float32), ("state", state, np.uint8)):
        if array.dtype != kind or array.shape != voxels.shape or array.ndim != 3:
            raise InvalidInputError(
                f"{name}: expected {np.dtype(kind)} of shape (n_k, n_j, n_i), as voxels, got "
                f"{array.dtype} of {array.shape}"
            )
        if not array.flags.c_contiguous:
            raise InvalidInputError(f"{name}: expected an array in C order, (k, j, i) with i fastest")
    if not 0 <= first <= stop <= voxels.shape[0]:
        raise InvalidInputError(
            f"first, stop: expected planes 0 to {voxels.shape[0]} in order, got {first} to {stop}"
        )
