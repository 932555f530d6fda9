"""What MATLAB's files hold: versions 5 to 7 by SciPy, version 7.3, which is HDF5 behind 512 bytes of text.

An array is named as in MATLAB, ``RcvData{1}`` or ``Trans.spacing`` or ``Receive(3).endSample``, counted from
1, and its axes are in MATLAB's order, the reverse of the order in which HDF5 shows them.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import open_regular
from speckle3d.core.geometry import require_finite
from speckle3d.core.printable import printable
from speckle3d.core.sweep import Frames
from speckle3d.io.formats.matlab_guard import require_sound
from speckle3d.io.hdf5 import (
    SIGNATURE,
    find_member,
    one_line,
    open_hdf5,
    plain_attribute,
    reading,
    require_dataset,
    require_readable,
)
from speckle3d.io.lazy import HDF5Slices, Turn

USER_BLOCK = 512
"""Bytes of text before the HDF5 part of version 7.3."""

_MOST_LEVELS, _MOST_LISTED, _MOST_ELEMENTS = 4, 400, 8
_STEP = re.compile(r"([A-Za-z]\w*)(?:\((\d{1,6})\)|\{(\d{1,6})\})?")

Step = tuple[str, int | None]


@dataclass(frozen=True)
class Listed:
    """An array of numbers: its name, its lengths in MATLAB's order, and their type."""

    name: str
    size: tuple[int, ...]
    kind: str

    def __str__(self) -> str:
        return f"{self.name} {' x '.join(map(str, self.size))} {self.kind}"


class MatFile(ABC):
    """An open file of MATLAB's."""

    reversed: bool
    """Whether the slices given to `turn` of frames have their axes in reverse."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @abstractmethod
    def arrays(self) -> list[Listed]:
        """All arrays of numbers, those in structs and cells too."""

    @abstractmethod
    def size(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
        """Lengths, in MATLAB's order, and type of an array."""

    @abstractmethod
    def values(self, name: str) -> npt.NDArray[Any]:
        """Read an array, its axes in MATLAB's order."""

    @abstractmethod
    def frames(
        self, names: list[str], axis: int | None, turn: Turn, shape: tuple[int, int, int], dtype: Any
    ) -> Frames:
        """Frames along an axis, in MATLAB's order, each made of its slices by `turn`."""

    @abstractmethod
    def close(self) -> None:
        """Close it."""

    def _none(self, name: str) -> InvalidInputError:
        there = ", ".join(map(str, self.arrays()[:_MOST_ELEMENTS])) or "none"
        return InvalidInputError(f"{self.path}: expected an array {printable(name)}, got {there}")


@contextmanager
def open_matlab(path: Path) -> Iterator[MatFile]:
    """Open a file of MATLAB's, of any version from 5 on.

    Raises
    ------
    FileError
        If it cannot be read.
    """
    with open_regular(path) as stream:
        stream.seek(USER_BLOCK)
        is_new = stream.read(len(SIGNATURE)) == SIGNATURE
    with _damage(path):
        file: MatFile = _NewFile(path) if is_new else _OldFile(path)
    try:
        with _damage(path):
            yield file
    finally:
        file.close()


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    with reading(path):
        try:
            yield
        except (IndexError, AttributeError, EOFError, SystemError, AssertionError, NameError) as error:
            raise FileError(f"{path}: cannot be read: {one_line(error)}") from error


def steps_of(name: str, path: Path) -> list[Step]:
    """Split the name of an array at its dots; the numbers in brackets count from 0."""
    steps: list[Step] = []
    for part in name.split("."):
        found = _STEP.fullmatch(part.strip())
        if found is None or "0" in (found[2], found[3]):
            raise InvalidInputError(
                f"{path}: arrays: expected a name as RcvData{{1}} or Trans.spacing, got {printable(name)}"
            )
        number = found[2] or found[3]
        steps.append((found[1], None if number is None else int(number) - 1))
    return steps


class _NewFile(MatFile):
    """Version 7.3: read frame by frame."""

    reversed = True

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._file = open_hdf5(path)

    def arrays(self) -> list[Listed]:
        found: list[Listed] = []
        self._list(self._file, "", found, 0)
        return found

    def _list(self, group: h5py.Group, before: str, found: list[Listed], level: int) -> None:
        for name in group:
            if not isinstance(name, str) or name.startswith("#") or len(found) >= _MOST_LISTED:
                continue
            member = find_member(group, name)
            if isinstance(member, h5py.Group) and level < _MOST_LEVELS:
                self._list(member, f"{before}{name}.", found, level + 1)
            elif isinstance(member, h5py.Dataset):
                self._list_data(member, f"{before}{name}", found, level)

    def _list_data(self, node: h5py.Dataset, name: str, found: list[Listed], level: int) -> None:
        if h5py.check_ref_dtype(node.dtype) is h5py.Reference:
            shown = min(node.size or 0, _MOST_ELEMENTS)
            for k in range(shown if level < _MOST_LEVELS else 0):
                below = self._followed(node, k)
                label = f"{name}{{{k + 1}}}"
                if isinstance(below, h5py.Group):
                    self._list(below, f"{label}.", found, level + 1)
                elif isinstance(below, h5py.Dataset):
                    self._list_data(below, label, found, level + 1)
        elif (
            _is_numeric(node.dtype)
            and node.shape
            and _class(node) != "char"
            and "MATLAB_empty" not in node.attrs
        ):
            found.append(Listed(printable(name), node.shape[::-1], _kind(node.dtype)))

    def _followed(self, node: h5py.Dataset, k: int) -> Any:
        """What a cell's or a struct array's element refers to, inside the file."""
        held = require_dataset(self._file, node.name)
        require_readable(held)
        references = held[()].ravel()
        if not 0 <= k < references.size:
            where = f"{self.path}: {printable(node.name)}"
            raise InvalidInputError(f"{where}: expected an element up to {references.size}, got {k + 1}")
        target = self._file[references[k]]
        if target.name is None:
            raise InvalidInputError(
                f"{self.path}: {printable(node.name)}: expected a named element, got none"
            )
        return find_member(self._file, target.name)

    def _node(self, name: str) -> h5py.Dataset:
        node: Any = self._file
        pending: int | None = None
        for step, index in steps_of(name, self.path):
            member = find_member(node, step) if isinstance(node, h5py.Group) else None
            if isinstance(member, h5py.Dataset) and h5py.check_ref_dtype(member.dtype) is h5py.Reference:
                # A struct array's fields are lists of references; so are cells, which say so.
                is_cell = (
                    "MATLAB_class" in member.attrs and plain_attribute(member, "MATLAB_class") == b"cell"
                )
                member = self._followed(member, (pending or 0) if not is_cell else (index or 0))
                pending = None if not is_cell else pending
                index = None
            elif pending:
                raise self._none(name)
            pending, node = index, member
        if (
            not isinstance(node, h5py.Dataset)
            or not _is_numeric(node.dtype)
            or _class(node) == "char"
            or pending
        ):
            raise self._none(name)
        return require_dataset(self._file, node.name)

    def size(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
        node = self._node(name)
        return node.shape[::-1], node.dtype

    def values(self, name: str) -> npt.NDArray[Any]:
        node = self._node(name)
        require_readable(node)
        return _complex(node[()]).T

    def frames(
        self, names: list[str], axis: int | None, turn: Turn, shape: tuple[int, int, int], dtype: Any
    ) -> Frames:
        nodes = [self._node(name) for name in names]
        stored = None if axis is None else nodes[0].ndim - 1 - axis
        return HDF5Slices(self.path, [node.name for node in nodes], stored, turn, shape, dtype)

    def close(self) -> None:
        self._file.close()


class _OldFile(MatFile):
    """Versions 5 to 7: a variable is loaded whole."""

    reversed = False

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        require_sound(path)
        self._loaded: dict[str, Any] = {}

    def arrays(self) -> list[Listed]:
        from scipy.io import whosmat

        found: list[Listed] = []
        for name, size, kind in whosmat(self.path):
            if kind in ("struct", "cell"):
                _list_loaded(self._variable(name), name, found, 0)
            elif kind not in ("char", "sparse", "function", "opaque", "object", "unknown"):
                found.append(Listed(printable(name), tuple(map(int, size)), kind))
        return found

    def _variable(self, name: str) -> Any:
        from scipy.io import loadmat

        if name not in self._loaded:
            self._loaded[name] = loadmat(self.path, variable_names=[name]).get(name)
        return self._loaded[name]

    def _node(self, name: str) -> npt.NDArray[Any]:
        (first, index), *rest = steps_of(name, self.path)
        node = self._element(self._variable(first), index, name)
        for step, index in rest:
            node = self._element(node, None, name)
            if not isinstance(node, np.void) or step not in (node.dtype.names or ()):
                raise self._none(name)
            node = self._element(node[step], index, name)
        if not isinstance(node, np.ndarray) or not _is_numeric(node.dtype):
            raise self._none(name)
        return node

    def _element(self, node: Any, index: int | None, name: str) -> Any:
        """One element of a cell or of a struct array; numbers as they are."""
        listed = isinstance(node, np.ndarray) and (node.dtype.names is not None or node.dtype == object)
        if not listed:
            if index:
                raise self._none(name)
            return node
        if (index is None and node.size != 1) or (index or 0) >= node.size:
            raise InvalidInputError(
                f"{self.path}: {printable(name)}: expected a number in brackets up to {node.size}, got "
                f"{'none' if index is None else index + 1}"
            )
        return node.ravel("F")[index or 0]

    def size(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
        node = self._node(name)
        return node.shape, node.dtype

    def values(self, name: str) -> npt.NDArray[Any]:
        return self._node(name)

    def frames(
        self, names: list[str], axis: int | None, turn: Turn, shape: tuple[int, int, int], dtype: Any
    ) -> Frames:
        made = np.empty(shape, dtype)
        arrays = [self._node(name) for name in names]
        by_frame = [array[None] if axis is None else np.moveaxis(array, axis, 0) for array in arrays]
        for i in range(shape[0]):
            frame = turn([array[i] for array in by_frame])
            if frame.dtype.kind in "fc":
                require_finite(frame, f"{self.path}: {printable(names[0])}: frame {i}")
            made[i] = frame
        return made

    def close(self) -> None:
        self._loaded.clear()


def _list_loaded(node: Any, name: str, found: list[Listed], level: int) -> None:
    """List the arrays of numbers in a loaded struct or cell."""
    if not isinstance(node, np.ndarray | np.void) or len(found) >= _MOST_LISTED or level > _MOST_LEVELS:
        return
    if isinstance(node, np.void):
        for field in node.dtype.names or ():
            _list_loaded(node[field], f"{name}.{field}", found, level + 1)
    elif node.dtype.names is not None or node.dtype == object:
        is_struct = node.dtype.names is not None
        for k, element in enumerate(node.ravel("F")[:_MOST_ELEMENTS]):
            brackets = f"({k + 1})" if is_struct else f"{{{k + 1}}}"
            label = name if is_struct and node.size == 1 else f"{name}{brackets}"
            _list_loaded(element, label, found, level + (not is_struct))
    elif _is_numeric(node.dtype) and node.size:
        found.append(Listed(printable(name), node.shape, _kind(node.dtype)))


def _class(node: h5py.Dataset) -> str:
    value = plain_attribute(node, "MATLAB_class")
    return value.decode("ascii", "replace") if isinstance(value, bytes) else str(value)


def _is_numeric(dtype: np.dtype[Any]) -> bool:
    return dtype.kind in "fiuc" or (dtype.names or ()) == ("real", "imag")


def _kind(dtype: np.dtype[Any]) -> str:
    return f"complex {dtype['real']}" if dtype.names else str(dtype)


def _complex(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Complex numbers of HDF5's pairs; others as they are."""
    return values["real"] + 1j * values["imag"] if values.dtype.names else values
