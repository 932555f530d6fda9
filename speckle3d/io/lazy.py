"""Frames that stay in their file and are read, and turned, one at a time."""

from __future__ import annotations

import operator
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import h5py
import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import FileError, InvalidInputError, naming
from speckle3d.core.files import PathLike, open_regular
from speckle3d.core.geometry import require_finite
from speckle3d.io.hdf5 import open_hdf5, reading, require_dataset

Slices: TypeAlias = Sequence[npt.NDArray[Any]]
Turn: TypeAlias = Callable[[Slices], npt.NDArray[Any]]
"""Makes a frame (vector, sample) of the slices that a file holds of it; a top-level function or a dataclass,
so that frames can be sent to another process."""


Unpack: TypeAlias = Callable[[], npt.NDArray[Any]]
"""Makes a frame of what was read of it, on several threads at once if need be."""


class OpenFrames(Protocol):
    """An open recording, asked by one thread at a time."""

    def read(self, i: int) -> Unpack:
        """Read what the file holds of frame `i`; the function returned makes it (vector, sample)."""

    def close(self) -> None:
        """Close it."""


class LazyFrames(ABC):
    """Frames read one at a time from a file that is opened at the first one asked for.

    It stays open until `close`, which may be called at any time: the next frame opens it again. A copy sent
    to another process opens it there.
    """

    any_thread = True
    """Several threads may read at once: each frame has memory of its own."""

    def __init__(self, path: PathLike, shape: tuple[int, int, int], dtype: npt.DTypeLike) -> None:
        self.path = Path(path).absolute()
        self.shape, self.dtype = shape, np.dtype(dtype)
        self._open: OpenFrames | None = None
        self._lock = threading.Lock()

    @abstractmethod
    def _opened(self) -> OpenFrames: ...

    def _where(self, i: int) -> str:
        return f"{self.path}: frame {i}"

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: int) -> npt.NDArray[Any]:
        i = operator.index(index)
        if not -len(self) <= i < len(self):
            raise IndexError(f"frame {i} of {len(self)}")
        i %= len(self)
        where = self._where(i)
        with self._lock, reading(where), naming(where):
            if self._open is None:
                self._open = self._opened()
            unpack = self._open.read(i)
        with reading(where), naming(where):
            frame = unpack()
            if frame.shape != self.shape[1:]:
                raise InvalidInputError(f"expected shape {self.shape[1:]}, got {frame.shape}")
        if frame.dtype.kind in "fc":
            require_finite(frame, where)
        return np.ascontiguousarray(frame, dtype=self.dtype)

    def close(self) -> None:
        """Close the file if it is open."""
        with self._lock:
            if self._open is not None:
                self._open.close()
                self._open = None

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("_open", "_lock")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _open=None, _lock=threading.Lock())


class HDF5Slices(LazyFrames):
    """Frames that are slices of data sets of an HDF5 file.

    Parameters
    ----------
    names : sequence of str
        Data sets that hold a part of each frame each, as real and imaginary parts.
    axis : int, optional
        Of the data sets: the frames. None where there is one frame and no axis for it.
    turn : callable
        Makes a frame of the data sets' slices, which lack that axis.
    grows : bool
        Whether the data sets may hold more frames, which are not looked at.
    """

    def __init__(
        self,
        path: PathLike,
        names: Sequence[str],
        axis: int | None,
        turn: Turn,
        shape: tuple[int, int, int],
        dtype: npt.DTypeLike,
        grows: bool = False,
    ) -> None:
        super().__init__(path, shape, dtype)
        self.names, self.axis, self.turn, self.grows = tuple(names), axis, turn, grows

    def _opened(self) -> OpenFrames:
        return _OpenSlices(self)

    def _where(self, i: int) -> str:
        return f"{self.path}: /{self.names[0].lstrip('/')}[{i}]"


class _OpenSlices:
    def __init__(self, frames: HDF5Slices) -> None:
        self._file, self._turn = open_hdf5(frames.path), frames.turn
        try:
            self._parts = [_Part(require_dataset(self._file, name), frames) for name in frames.names]
        except BaseException:
            self._file.close()
            raise

    def read(self, i: int) -> Unpack:
        unpacks = [part.read(i) for part in self._parts]
        return lambda: self._turn([unpack() for unpack in unpacks])

    def close(self) -> None:
        self._file.close()


class _Part:
    """An open data set and HDF5's handles to it, made once.

    h5py frees a handle in a callback, and Python drops a Ctrl-C that is pending there: the one pressed while
    a frame was read. So no handle is freed from frame to frame.
    """

    def __init__(self, data: h5py.Dataset, frames: HDF5Slices) -> None:
        self._data, self._axis = data, frames.axis
        found = 1 if self._axis is None else data.shape[self._axis] if self._axis < data.ndim else 0
        if found != len(frames) and not (frames.grows and found > len(frames)):
            raise InvalidInputError(
                f"{data.name}: expected {len(frames)} frames on axis {self._axis}, got shape {data.shape}"
            )
        self._start = [0] * data.ndim
        self._count = tuple(1 if axis == self._axis else n for axis, n in enumerate(data.shape))
        self._shape = tuple(n for axis, n in enumerate(data.shape) if axis != self._axis)
        self._dtype = data.dtype.newbyteorder("=")
        self._node, self._on_disk = data.id, data.id.get_space()
        self._in_memory = h5py.h5s.create_simple(self._shape or (1,))
        self._kind = h5py.h5t.py_create(self._dtype)
        # As they lie in the file, twice as fast as by way of HDF5's cache of chunks.
        self._is_plain = (
            self._axis == 0
            and data.chunks == (1, *self._shape)
            and not data.id.get_create_plist().get_nfilters()
            and data.dtype == self._dtype
        )

    def read(self, i: int) -> Unpack:
        values = np.empty(self._shape or (1,), self._dtype)
        if self._axis is not None:
            self._start[self._axis] = i
        if self._is_plain:
            if self._node.get_chunk_info_by_coord(tuple(self._start)).byte_offset is None:
                raise InvalidInputError("expected chunks of its samples in the file, got none: never written")
            self._node.read_direct_chunk(tuple(self._start), out=values.reshape(-1).view(np.uint8))
        else:
            self._on_disk.select_hyperslab(tuple(self._start), self._count)
            self._node.read(self._in_memory, self._on_disk, values, self._kind)
        return lambda: values.reshape(self._shape)


class RawFrames(LazyFrames):
    """Frames of numbers one after the other in a plain file.

    Parameters
    ----------
    start : int
        Byte of the first frame's first number.
    step : int
        Bytes from frame to frame.
    stored : dtype
        Of the numbers in the file, with their byte order.
    turn : callable
        Makes a frame of its numbers, which come flat.
    """

    def __init__(
        self,
        path: PathLike,
        start: int,
        step: int,
        stored: npt.DTypeLike,
        turn: Turn,
        shape: tuple[int, int, int],
        dtype: npt.DTypeLike,
    ) -> None:
        super().__init__(path, shape, dtype)
        self.start, self.step, self.stored, self.turn = start, step, np.dtype(stored), turn

    def _opened(self) -> OpenFrames:
        return _OpenRaw(self)


class _OpenRaw:
    def __init__(self, frames: RawFrames) -> None:
        self._frames = frames

    def read(self, i: int) -> Unpack:
        return partial(self._frame, i)

    def _frame(self, i: int) -> npt.NDArray[Any]:
        frames = self._frames
        count = frames.shape[1] * frames.shape[2]
        expected = count * frames.stored.itemsize
        with open_regular(frames.path) as stream:
            stream.seek(frames.start + i * frames.step)
            content = stream.read(expected)
        if len(content) != expected:
            where = f"{frames.path}: frame {i}"
            raise FileError(f"{where}: expected {expected} bytes, got {len(content)}: truncated")
        return frames.turn([np.frombuffer(content, frames.stored)])

    def close(self) -> None:
        """Nothing stays open between frames."""


@dataclass(frozen=True)
class Layout:
    """Order of a frame's numbers in a file.

    Attributes
    ----------
    shape : tuple of int
        Into which they are put, the last axis running fastest.
    axes : tuple of int
        Where vectors and samples are among its axes; other axes have length 1.
    """

    shape: tuple[int, ...]
    axes: tuple[int, int]

    def of(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Turn numbers to (vector, sample)."""
        shaped = values.reshape(self.shape)
        return np.moveaxis(shaped, self.axes, (0, 1)).reshape([self.shape[axis] for axis in self.axes])


@dataclass(frozen=True)
class Real:
    """Turns numbers as they are."""

    layout: Layout

    def __call__(self, slices: Slices) -> npt.NDArray[Any]:
        """Make a frame."""
        return self.layout.of(slices[0])


@dataclass(frozen=True)
class Complex:
    """Turns real and imaginary parts, or I and Q."""

    layout: Layout

    def __call__(self, slices: Slices) -> npt.NDArray[Any]:
        """Make a frame."""
        real, imaginary = (self.layout.of(part) for part in slices)
        made = np.empty(real.shape, np.complex64)
        made.real, made.imag = real, imaginary
        return made


@dataclass(frozen=True)
class Pairs:
    """Turns numbers whose last axis is I and Q."""

    layout: Layout

    def __call__(self, slices: Slices) -> npt.NDArray[Any]:
        """Make a frame."""
        return Complex(self.layout)([slices[0][..., 0], slices[0][..., 1]])
