"""The rule "plus": means kept in whole grey levels, as PLUS and 3D Slicer keep them.

For comparing volumes with theirs, voxel by voxel. Both stand on IGSIO, whose ``vtkIGSIOPasteSliceIntoVolume``
differs from the mean of the samples, with ``Optimization="FULL"`` (the default), in this:

- Places, and the steps from a pixel to the next, are whole multiples of 2^-14 voxel: over a row of 820
  pixels a place is off by up to 0.025 voxel.
- Rows are taken from the top and columns from the left, and the mean is a whole grey level after each pixel:
  cut with "nearest", so that it falls, and rounded with "linear", so that late pixels do not move it.
- Weights are kept in 16 bits, in steps of 1/256 pixel: from the 256th pixel on, each counts for 1/256.
- Pixels come in the order of one thread; with more, PLUS's own volumes may differ between runs.
- With "linear", a pixel that has a share in a voxel beyond the grid counts nowhere.

Holes are filled as for the other rules, not along PLUS's sticks: compare without filling. On PLUS's own grid
and at its own matrices volumes are equal to the last level. Poses are rigid here, and headers have six digits
of the origin; by that much, 0.0005 mm, some pixels fall into another voxel.
"""

from __future__ import annotations

import numpy as np

from speckle3d.core.arrays import ByteArray, Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.imaging.voxels.grid import VoxelGrid
from speckle3d.imaging.voxels.settings import Splat
from speckle3d.imaging.voxels.splatting import Placed, batches, share_out, spans_of

_POSITION_BITS, _PLACE_BITS = 40, 14
_TYPES = ("uint8", "int16", "uint16", "float32", "float64")
"""Of images: the first is worked on, and the others told apart in errors."""


def splat_block_whole(
    placed: Placed, voxel_grid: VoxelGrid, splat: Splat, first: int, stop: int
) -> tuple[Float32Array, ByteArray]:
    """Give images to the voxels of some planes, pixel by pixel.

    Parameters
    ----------
    placed : Placed
        On `voxel_grid`; of images of uint8. Its weights are not read.
    voxel_grid : VoxelGrid
    splat : {"nearest", "linear"}
    first, stop : int
        Planes along k.

    Returns
    -------
    voxels : ndarray of float32, shape (stop - first, n_j, n_i)
        Whole levels; NaN where the weight is zero.
    state : ndarray of uint8
        1 where it is not, else 0.

    Raises
    ------
    InvalidInputError
        If images are of another type.
    """
    from speckle3d.kernels.whole_levels import add_linear_whole, add_nearest_whole

    n_i, n_j, n_k = voxel_grid.shape
    shape = (stop - first, n_j, n_i)
    levels, weights = np.zeros(shape, np.uint8), np.zeros(shape, np.uint16)
    room = np.array([[0, n_i], [0, n_j], [-first, n_k - first]], dtype=np.int64)
    planes = np.array([[0, n_i], [0, n_j], [first, stop]], dtype=np.int64)
    spans = spans_of(placed.source, placed.mask, turned=True)
    for batch in batches(placed.source, placed.touching(planes), _TYPES, by_row=True):
        images, maps = batch.images, fixed_maps(placed.index_from_sample[batch.frames], splat, first)
        if images.dtype != np.uint8:
            raise InvalidInputError(
                f"rule plus: expected images of type uint8, B-mode as stored, got {images.dtype}"
            )

        def work(box: IntArray, images: ByteArray = images, maps: IntArray = maps) -> None:
            if splat == "nearest":
                add_nearest_whole(images, maps, spans, box, levels, weights)
            else:
                add_linear_whole(images, maps, spans, box, room, levels, weights)

        share_out(work, shape, maps, images.shape[1:])
    measured = weights > 0
    return np.where(measured, levels, np.float32(np.nan)), measured.view(np.uint8)


def fixed_maps(index_from_sample: FloatArray, splat: Splat, first_plane: int) -> IntArray:
    """Maps from (row, column, 1) to multiples of 2^-14 voxel, in units of 2^-40, from `first_plane` on."""
    coarse = np.rint(index_from_sample[:, :, [1, 0, 2]] * 2.0**_PLACE_BITS).astype(np.int64)
    if splat == "nearest":
        coarse[:, :, 2] += 1 << (_PLACE_BITS - 1)
    coarse[:, 2, 2] -= first_plane << _PLACE_BITS
    return np.ascontiguousarray(coarse << (_POSITION_BITS - _PLACE_BITS))
