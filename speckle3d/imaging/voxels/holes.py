"""Filling empty voxels from the measured ones nearby."""

from __future__ import annotations

import numpy as np

from speckle3d.core.arrays import ByteArray, Float32Array, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.threads import in_parallel

MAX_RADIUS = 255
"""Largest half edge of a box, to catch wrong units, and within what counts of four bytes hold."""


def fill_holes(
    voxels: Float32Array,
    state: ByteArray,
    radius_mm: float,
    spacing_mm: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> None:
    """Fill empty voxels from measured ones nearby; these are never changed.

    An empty voxel becomes the mean of the measured voxels in the smallest box around it that holds any, and
    is marked as filled. Filled voxels fill no others, so that a second call changes nothing.

    Parameters
    ----------
    voxels : ndarray of float32, shape (n_k, n_j, n_i), C order, changed in place
        What empty ones hold does not matter.
    state : ndarray of uint8, shape (n_k, n_j, n_i), C order, changed in place
        `EMPTY`, `MEASURED` or `FILLED` of `speckle3d.core.volume`.
    radius_mm, spacing_mm : float, tuple of float
        Of the largest box, as for `boxes_within`; in voxels without a spacing.

    Examples
    --------
    >>> voxels = np.array([[[10.0, 0.0, 0.0, 0.0, 30.0]]], np.float32)
    >>> state = np.array([[[1, 0, 0, 0, 1]]], np.uint8)
    >>> fill_holes(voxels, state, 2)
    >>> voxels[0, 0].tolist(), state[0, 0].tolist()
    ([10.0, 10.0, 20.0, 30.0, 30.0], [1, 2, 2, 2, 1])
    """
    from speckle3d.kernels.holes import fill_planes

    boxes = boxes_within(radius_mm, spacing_mm)
    if len(boxes):
        in_parallel(lambda first, stop: fill_planes(voxels, state, boxes, first, stop), len(voxels), 2)


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
    # A hair more, so that rounding does not leave a voxel out that lies right at the radius.
    hair, spacing = 1 + 1e-9, np.array(spacing_mm, dtype=float)[::-1]
    distances = [step * np.arange(1, int(radius_mm / step * hair) + 1) for step in spacing]
    half_edges = np.floor(np.concatenate(distances)[:, None] / spacing * hair).astype(np.int64)
    return np.asarray(np.unique(half_edges, axis=0).reshape(-1, 3))
