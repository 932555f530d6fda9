"""Frames that stay in a file and are read, and turned, one at a time."""

import operator
import threading
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np

from speckle3d.core.arrays import AnyArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.files import PathLike
from speckle3d.core.geometry import require_finite
from speckle3d.io.hdf5 import open_hdf5, reading, require_dataset

ReadFrame = Callable[[int], AnyArray]
"""Reads frame i of an open file, shape (vector, sample)."""


def from_pairs(pairs: AnyArray) -> AnyArray:
    """Complex samples of pairs of I and Q, the last axis."""
    return pairs.astype(np.float32).view(np.complex64)[..., 0]


@dataclass(eq=False, repr=False)
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

    path: PathLike
    open_file: Callable[[], ReadFrame]
    shape: tuple[int, int, int]
    dtype: Any
    stored_dtype: Any = None
    numbers: Any = None
    any_thread = True

    def __post_init__(self) -> None:
        self.path, self.dtype = Path(self.path).absolute(), np.dtype(self.dtype)
        if self.numbers is None:
            self.numbers = range(self.shape[0])
        self.shape = (len(self.numbers), *self.shape[1:])
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

    def take(self, rows: AnyArray, axis: int = 0) -> Self:
        """Subset of the frames, as by `numpy.take`."""
        return replace(self, numbers=[self.numbers[i] for i in rows.tolist()])

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return FileFrames, tuple(getattr(self, part.name) for part in fields(self))


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
        parts = [_slicer(require_dataset(file, name), self.axis) for name in self.names]
        return lambda i: self.turn(*(part(i) for part in parts))

    def _frame_of_growing(self, i: int) -> AnyArray:
        with open_hdf5(self.path) as file:
            return self._reader(file)(i)


def _slicer(data: h5py.Dataset, axis: int | None) -> ReadFrame:
    """Slices along an axis; plain chunks as they lie in the file, twice as fast as by h5py."""
    if axis is None:
        return lambda i: np.asarray(data[()])
    shape, kind = data.shape[1:], data.dtype
    is_plain = kind.kind in "iuf" and kind.isnative and data.chunks == (1, *shape)
    if axis or not is_plain or data.id.get_create_plist().get_nfilters():
        return lambda i: np.asarray(data[(*(slice(None),) * axis, i)])

    def read_chunk(i: int) -> AnyArray:
        values = np.empty(shape, kind)
        data.id.read_direct_chunk((i, *(0,) * values.ndim), out=values.reshape(-1).view(np.uint8))
        return values

    return read_chunk
