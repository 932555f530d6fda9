"""Frames that stay in an HDF5 file and are read one at a time."""

from __future__ import annotations

import operator
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import h5py
import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.files import PathLike
from speckle3d.core.geometry import require_finite
from speckle3d.io.hdf5 import open_hdf5, reading, require_dataset

Turn: TypeAlias = Callable[[npt.NDArray[Any]], npt.NDArray[Any]]
"""Makes a frame (vector, sample) of what the file holds of it; a top-level function, so that frames can be
sent to another process."""


class HDF5Slices:
    """Frames that are slices of a data set along its first axis.

    The file is opened at the first frame asked for and stays open until `close`, which may be called at any
    time: the next frame opens it again. A copy sent to another process opens it there.

    Parameters
    ----------
    name : str
        Of the data set.
    turn : callable
        Makes a frame of a slice.
    shape : tuple of int
        (frame, vector, sample).
    grows : bool
        Whether the data set may hold more frames, which are not looked at.
    """

    any_thread = True
    """Several threads may read at once: each frame has memory of its own."""

    def __init__(
        self,
        path: PathLike,
        name: str,
        turn: Turn,
        shape: tuple[int, int, int],
        dtype: npt.DTypeLike,
        grows: bool = False,
    ) -> None:
        self.path, self.name, self.turn, self.grows = Path(path).absolute(), name, turn, grows
        self.shape, self.dtype = shape, np.dtype(dtype)
        self._data: _OpenData | None = None
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: int) -> npt.NDArray[Any]:
        i = operator.index(index)
        if not -len(self) <= i < len(self):
            raise IndexError(f"frame {i} of {len(self)}")
        i %= len(self)
        where = f"{self.path}: /{self.name}[{i}]"
        with reading(where), naming(where):
            with self._lock:
                if self._data is None:
                    self._data = _OpenData(self)
                values = self._data.read(i)
            frame = self.turn(values)
            if frame.shape != self.shape[1:]:
                raise InvalidInputError(f"expected shape {self.shape[1:]}, got {frame.shape}")
        if frame.dtype.kind in "fc":
            require_finite(frame, where)
        return np.ascontiguousarray(frame, dtype=self.dtype)

    def close(self) -> None:
        """Close the file if it is open."""
        with self._lock:
            if self._data is not None:
                self._data.file.close()
                self._data = None

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("_data", "_lock")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _data=None, _lock=threading.Lock())


class _OpenData:
    """An open data set and HDF5's handles to it, made once.

    h5py frees a handle in a callback, and Python drops a Ctrl-C that is pending there: the one pressed while
    a frame was read. So no handle is freed from frame to frame.
    """

    def __init__(self, frames: HDF5Slices) -> None:
        self.file = open_hdf5(frames.path)
        try:
            data = require_dataset(self.file, frames.name)
            count = data.shape[0] if data.ndim else 0
            if count < len(frames) or (count > len(frames) and not frames.grows):
                raise InvalidInputError(f"{data.name}: expected {len(frames)} frames, got shape {data.shape}")
        except BaseException:
            self.file.close()
            raise
        self._shape, self._dtype = data.shape[1:], data.dtype.newbyteorder("=")
        self._node, self._on_disk = data.id, data.id.get_space()
        self._in_memory = h5py.h5s.create_simple(self._shape or (1,))
        self._kind = h5py.h5t.py_create(self._dtype)
        # As they lie in the file, twice as fast as by way of HDF5's cache of chunks.
        self._is_plain = (
            data.chunks == (1, *self._shape)
            and not data.id.get_create_plist().get_nfilters()
            and data.dtype == self._dtype
        )

    def read(self, i: int) -> npt.NDArray[Any]:
        """Read what the file holds of frame `i`."""
        values, start = np.empty(self._shape, self._dtype), (i, *(0,) * len(self._shape))
        if self._is_plain:
            if self._node.get_chunk_info_by_coord(start).byte_offset is None:
                raise InvalidInputError("expected chunks of its samples in the file, got none: never written")
            self._node.read_direct_chunk(start, out=values.reshape(-1).view(np.uint8))
        else:
            self._on_disk.select_hyperslab(start, (1, *self._shape))
            self._node.read(self._in_memory, self._on_disk, values, self._kind)
        return values
