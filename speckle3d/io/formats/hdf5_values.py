"""Numbers, frames and grey levels of HDF5 files of others, whose shapes differ by who wrote them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import h5py
import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import plausible_bytes
from speckle3d.core.printable import printable
from speckle3d.io.frames import FileFrames, ReadFrame
from speckle3d.io.hdf5 import has_member, locate, open_hdf5, read_checked, require_dataset

Turn: TypeAlias = Callable[[Sequence[npt.NDArray[Any]]], npt.NDArray[Any]]

ENVELOPE_RANGE_DB = 80.0
"""Of grey levels made here unless another is given: 0.31 dB a level, while speckle itself spreads by 5.6
dB."""

_MOST_TIMES_STORED = 1032
"""Deflate packs a byte into no less than 1/1032 of one [RFC 1951: 258 bytes in 2 bits]."""
_NOTHING_DB = -1e6


def dataset(group: h5py.Group, name: str) -> h5py.Dataset:
    """A data set of numbers, refused if there is none, or more is claimed than was written."""
    node = require_dataset(group, name)
    if node.dtype.kind not in "fiubcV" or node.shape is None:
        raise InvalidInputError(f"{locate(group, name)}: expected numbers, got {node.dtype}")
    stored = node.id.get_storage_size()
    if node.nbytes > plausible_bytes(stored, _MOST_TIMES_STORED) or (node.nbytes and not stored):
        raise InvalidInputError(
            f"{locate(group, name)}: expected {node.shape} numbers, got {stored} bytes: never written"
        )
    return node


def flat(group: h5py.Group, name: str) -> FloatArray:
    """Read finite numbers along one axis, whatever other axes of length 1 there are."""
    values: FloatArray = read_checked(group, name, None)
    if sum(n > 1 for n in values.shape) > 1 or not np.isfinite(values).all():
        raise InvalidInputError(
            f"{locate(group, name)}: expected finite numbers along one axis, got others, {values.shape}"
        )
    return values.ravel()


def single(group: h5py.Group, name: str) -> float | None:
    """Read one finite number; None if there is none, or an empty array, of this name.

    Raises
    ------
    InvalidInputError
        If there are several that differ, as one per transmission may.
    """
    values = flat(group, name) if has_member(group, name) else np.zeros(0)
    if values.size and np.ptp(values):
        raise InvalidInputError(
            f"{locate(group, name)}: expected one number, got {values.min():g} to {values.max():g}"
        )
    return float(values[0]) if values.size else None


def text_attribute(node: h5py.HLObject, name: str) -> str:
    """Text of an attribute, of the first if there are several; empty where there is none."""
    return text_of(node.attrs.get(name, ""))


def text_of(value: Any) -> str:
    """Text of what HDF5 holds, of the first if there are several."""
    first = next(iter(np.ravel(value)), "")
    return printable(first.decode("utf-8", "replace") if isinstance(first, bytes) else str(first)).strip("\0")


@dataclass(frozen=True)
class Grid:
    """Turns numbers of a frame into (vector, sample).

    Attributes
    ----------
    shape : tuple of int
        Into which the numbers are put, the last axis running fastest.
    axes : tuple of int
        Where vectors and samples are among its axes; others have length 1.
    pairs : bool
        Whether the last axis is I and Q.
    """

    shape: tuple[int, ...]
    axes: tuple[int, int]
    pairs: bool = False

    def __call__(self, parts: Sequence[npt.NDArray[Any]]) -> npt.NDArray[Any]:
        """Make a frame of one data set, or of real and imaginary parts."""
        if self.pairs:
            parts = [parts[0][..., 0], parts[0][..., 1]]
        elif parts[0].dtype.names:
            parts = [parts[0]["real"], parts[0]["imag"]]
        size = [self.shape[axis] for axis in self.axes]
        turned = [np.moveaxis(part.reshape(self.shape), self.axes, (0, 1)).reshape(size) for part in parts]
        if len(turned) == 1:
            return turned[0]
        made = turned[0].astype(np.complex64)
        made.imag = turned[1]
        return made


@dataclass(frozen=True)
class Levels:
    """Turns decibels, or an echo's amplitude, into grey levels, 255 at `top`, 0 that range below."""

    grid: Grid
    decibels: bool
    top: float | None = None
    dynamic_range_db: float = ENVELOPE_RANGE_DB

    def __call__(self, parts: Sequence[npt.NDArray[Any]]) -> npt.NDArray[Any]:
        """Make a frame."""
        values = self.grid(parts).astype(np.float64)
        if self.top is None:
            return np.where(np.isneginf(values), _NOTHING_DB, values)
        with np.errstate(divide="ignore", invalid="ignore"):
            below = values - self.top if self.decibels else 20.0 * np.log10(values / self.top)
        if np.isnan(below).any():
            raise InvalidInputError("expected echoes' amplitudes, got NaN or a negative one")
        return np.rint(np.clip(255.0 * (1.0 + below / self.dynamic_range_db), 0.0, 255.0)).astype(np.uint8)


@dataclass(frozen=True)
class HDF5File:
    """Opens frames that are slices of data sets.

    Attributes
    ----------
    names : tuple of str
        Data sets that hold a part of each frame each, as real and imaginary parts.
    axis : int, optional
        Of the data sets: the frames. None where there is one frame and no axis for it.
    turn : callable
        Makes a frame of the data sets' slices, which lack that axis.
    """

    path: Path
    names: tuple[str, ...]
    axis: int | None
    turn: Turn

    def __call__(self) -> ReadFrame:
        """Open the file."""
        file = open_hdf5(self.path)
        nodes = [dataset(file, name) for name in self.names]
        before = (slice(None),) * (self.axis or 0)

        def read(i: int) -> npt.NDArray[Any]:
            return self.turn([node[() if self.axis is None else (*before, i)] for node in nodes])

        return read

    def frames(self, shape: tuple[int, int, int], dtype: npt.DTypeLike) -> FileFrames:
        """Frames of a shape (frame, vector, sample)."""
        return FileFrames(self.path, self, shape, dtype)

    def grey_frames(
        self, shape: tuple[int, int, int], grid: Grid, decibels: bool, dynamic_range_db: float | None
    ) -> tuple[FileFrames, float, float]:
        """Frames of grey levels; all frames are read once to find the strongest echo, which becomes 255.

        Returns
        -------
        frames : FileFrames
        top, dynamic_range_db : float
            What 255 stands for, and how far below it 0 is.

        Raises
        ------
        InvalidInputError
            If there is no echo at all.
        """
        plain = replace(self, turn=Levels(grid, decibels)).frames(shape, np.float64)
        top = max((float(plain[i].max()) for i in range(shape[0])), default=0.0)
        plain.close()
        if not (decibels or top > 0):
            raise InvalidInputError(f"{self.path}: expected echoes, got amplitudes up to {top:g}")
        span = dynamic_range_db or ENVELOPE_RANGE_DB
        return replace(self, turn=Levels(grid, decibels, top, span)).frames(shape, np.uint8), top, span
