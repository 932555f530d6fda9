"""Numbers and axes in HDF5 files of others, whose shapes differ by who wrote them: (n,), (n, 1), (1, n)."""

from __future__ import annotations

import h5py
import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.io.hdf5 import has_member, locate, reading, require_dataset, require_readable


def flat(group: h5py.Group, name: str) -> FloatArray:
    """Read finite numbers along one axis, whatever other axes of length 1 there are.

    Raises
    ------
    InvalidInputError
        If there are none of this name, of another kind, or along several axes.
    """
    node, where = require_dataset(group, name), locate(group, name)
    if node.dtype.kind not in "fiu" or node.shape is None or sum(n > 1 for n in node.shape) > 1:
        raise InvalidInputError(f"{where}: expected numbers along one axis, got {node.shape} {node.dtype}")
    with reading(where), naming(where):
        require_readable(node)
        values = np.asarray(node[()], dtype=np.float64).ravel()
    if not np.isfinite(values).all():
        raise InvalidInputError(f"{where}: expected finite numbers, got {values[~np.isfinite(values)][0]}")
    return values


def single(group: h5py.Group, name: str) -> float | None:
    """Read one finite number; None if there is none, or an empty array, of this name.

    Raises
    ------
    InvalidInputError
        If there are several that differ, as one per transmission may.
    """
    if not has_member(group, name):
        return None
    values = flat(group, name)
    if values.size == 0:
        return None
    if (values != values[0]).any():
        raise InvalidInputError(
            f"{locate(group, name)}: expected one number, got {values.min():g} to {values.max():g}"
        )
    return float(values[0])
