"""Frames that stay in a file and are read, and turned, one at a time."""

from __future__ import annotations

import operator
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import h5py
import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import AnyArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.files import PathLike
from speckle3d.core.geometry import require_finite
from speckle3d.io.hdf5 import open_hdf5, reading, require_dataset

ReadFrame: TypeAlias = Callable[[int], AnyArray]
"""Reads frame i of an open file, shape (vector, sample)."""


class FileFrames:
    """Frames of a file that is opened when the first one is asked for; several threads may read.

    Parameters
    ----------
    open_file : callable
        Opens the file and returns what reads a frame of it. It must survive pickling (a dataclass with
        `__call__`), so that frames can be sent to another process, which opens the file anew.
    shape : tuple of int
        (frame, vector, sample).
    stored_dtype : dtype, optional
        Narrower type that a sweep file may keep them in: int16 of I/Q.
    numbers : sequence of int, optional
        Numbers of the frames in the file; by default all of them in order.
    """

    any_thread = True

    def __init__(
        self,
        path: PathLike,
        open_file: Callable[[], ReadFrame],
        shape: tuple[int, int, int],
        dtype: npt.DTypeLike,
        stored_dtype: npt.DTypeLike | None = None,
        numbers: Sequence[int] | None = None,
    ) -> None:
        self.path, self.open_file = Path(path).absolute(), open_file
        self.numbers = range(shape[0]) if numbers is None else numbers
        self.shape, self.dtype = (len(self.numbers), *shape[1:]), np.dtype(dtype)
        self.stored_dtype = np.dtype(dtype if stored_dtype is None else stored_dtype)
        self._read: ReadFrame | None = None
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: int | slice) -> AnyArray:
        if isinstance(index, slice):
            return np.stack([self[i] for i in range(*index.indices(len(self)))])
        i = self.numbers[operator.index(index)]
        where = f"{self.path}: frame {i}"
        with self._lock, reading(where), naming(where):
            if self._read is None:
                self._read = self.open_file()
            frame = self._read(i)
        if frame.shape != self.shape[1:]:
            raise InvalidInputError(f"{where}: expected shape {self.shape[1:]}, got {frame.shape}")
        with np.errstate(over="ignore"):  # what float32 does not hold is refused as not finite
            frame = np.ascontiguousarray(frame, dtype=self.dtype)
        if frame.dtype.kind in "fc":
            require_finite(frame, where)
        return frame

    def take(self, rows: AnyArray, axis: int = 0) -> FileFrames:
        """Subset of the frames, as by `numpy.take`."""
        kind, (*others, numbers) = self.__reduce__()
        part: FileFrames = kind(*others, [numbers[i] for i in rows.tolist()])
        return part

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        own = self.path, self.open_file, self.shape, self.dtype, self.stored_dtype, self.numbers
        return FileFrames, own


@dataclass(frozen=True)
class HDF5Slices:
    """Opens frames that are slices of data sets.

    Attributes
    ----------
    names : tuple of str
        Data sets that hold a part of each frame each, as real and imaginary parts.
    turn : callable
        Makes a frame (vector, sample) of the data sets' slices; a top-level function or a dataclass, so that
        frames can be sent to another process.
    axis : int, optional
        Of the data sets: the frames. None where there is one frame and no axis for it.
    """

    path: Path
    names: tuple[str, ...]
    turn: Callable[..., AnyArray]
    axis: int | None = 0

    def __call__(self) -> ReadFrame:
        """Open the file; one that grows is opened for each frame, as HDF5 keeps an open one as it was."""
        file = open_hdf5(self.path)
        if not file.swmr_mode:
            return self._reader(file)
        file.close()
        return self._frame_of_growing

    def _reader(self, file: h5py.File) -> ReadFrame:
        sets = [require_dataset(file, name) for name in self.names]
        return lambda i: self.turn(*(_slice(data, self.axis, i) for data in sets))

    def _frame_of_growing(self, i: int) -> AnyArray:
        with open_hdf5(self.path) as file:
            return self._reader(file)(i)


def _slice(data: h5py.Dataset, axis: int | None, i: int) -> AnyArray:
    """Slice along an axis; a plain chunk as it lies in the file, twice as fast as by h5py."""
    if axis is None:
        return np.asarray(data[()])
    is_plain = data.dtype.kind in "iuf" and data.dtype.isnative and data.chunks == (1, *data.shape[1:])
    if axis or not is_plain or data.id.get_create_plist().get_nfilters():
        return np.asarray(data[(*(slice(None),) * axis, i)])
    values = np.empty(data.shape[1:], data.dtype)
    data.id.read_direct_chunk((i, *(0,) * values.ndim), out=values.reshape(-1).view(np.uint8))
    return values
