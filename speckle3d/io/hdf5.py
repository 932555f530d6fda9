"""HDF5 files of this package: written whole or not at all, read with errors that name the place."""

from __future__ import annotations

import hashlib
import os
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeAlias

import h5py
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import FileError, InvalidInputError, Speckle3DError, naming
from speckle3d.core.files import PathLike as PathLike
from speckle3d.core.files import open_regular
from speckle3d.core.geometry import transforms_from_matrices
from speckle3d.core.parts import DiskFile, cannot_write, clear_parts, marked, part_beside
from speckle3d.io.hdf5_beside import CHUNK_CACHE_BYTES, has_writer, open_beside_writer
from speckle3d.io.hdf5_beside import SIGNATURE as SIGNATURE
from speckle3d.io.hdf5_guard import (
    follow,
    plain_attribute,
    require_held,
    require_plausible_rows,
    require_readable,
    require_sound_heaps,
    require_texts,
)
from speckle3d.io.meanings import label

Node: TypeAlias = h5py.Group | h5py.Dataset

_READ_FAILURES = (
    OSError,
    RuntimeError,
    KeyError,
    ValueError,
    TypeError,
    MemoryError,
    OverflowError,
    zlib.error,
)
"""What h5py and zlib raise, by place, when the bytes of a file do not make sense."""

_ACCEPTED_KINDS = {"f": "fiu", "i": "iu", "b": "biu"}
"""Stored kinds that may become the kind asked for."""


@contextmanager
def atomic_path(path: PathLike) -> Iterator[Path]:
    """Yield a temporary sibling that becomes `path` when the block succeeds and vanishes when it does not.

    The sibling keeps the suffix, by which some writers choose their format. Siblings that killed processes
    left are removed.

    Raises
    ------
    FileError
        If the folder does not exist, `path` is not an ordinary file, or the system refuses to write.
    """
    target = require_target(path)
    clear_parts(target)
    part = part_beside(target)
    try:
        with marked(part):
            yield part
            os.replace(part, target)
    except Speckle3DError:
        raise
    except OSError as error:
        raise cannot_write(path, error) from error
    finally:
        part.unlink(missing_ok=True)


def require_target(path: PathLike) -> Path:
    """Path of a file that may be written, resolved; to be asked before long work, too.

    Raises
    ------
    FileError
        If the folder does not exist, or `path` is not an ordinary file.
    """
    target = Path(path).resolve()
    if target.exists() and not target.is_file():
        raise FileError(f"{path}: expected an ordinary file to write, got a folder or device")
    if not target.parent.is_dir():
        raise FileError(f"{path}: expected an existing folder, got {target.parent}")
    return target


def make_folder(path: PathLike) -> None:
    """Make a folder for results, and those above it, unless it is there.

    Raises
    ------
    FileError
        If a file of the name is in the way, or the system refuses.
    """
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(path, error, "cannot be made a folder") from error


@contextmanager
def atomic_hdf5(path: PathLike, format_name: str, version: int = 1) -> Iterator[h5py.File]:
    """Open an HDF5 file of the family for writing; `path` appears whole or not at all (`atomic_path`)."""
    with atomic_path(path) as part, DiskFile(part) as disk, h5py.File(disk, "w") as file:
        file.attrs["format"] = format_name
        file.attrs["version"] = version
        yield file
        label(file)


class HDF5Writer:
    """Write a file of the family in a block; it appears whole when the block ends, or not at all."""

    def __init__(self, path: PathLike, format_name: str, version: int) -> None:
        self._path, self._format = path, (format_name, version)
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            part = stack.enter_context(atomic_path(self._path))
            self._disk = stack.enter_context(DiskFile(part))
            self._file = stack.enter_context(h5py.File(self._disk, "w"))
            for name, value in zip(("format", "version"), self._format, strict=True):
                self._file.attrs[name] = value
            stack.push(self._finish_unless)
            self._begin()
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def _require_room(self) -> None:
        """Raise if what was written so far does not fit on the disk; to be called after every piece."""
        self._disk.check()

    def _begin(self) -> None:
        """Write what is known before the block."""

    def _finish(self) -> None:
        """Write what is known when the block has ended without an error."""

    def _finish_unless(self, _: object, error: BaseException | None, __: object) -> None:
        if error is None:
            self._finish()
            label(self._file)


def open_hdf5(path: PathLike) -> h5py.File:
    """Open an HDF5 file for reading.

    Raises
    ------
    FileError
        If it is missing, truncated or not HDF5.
    """
    require_file(path)
    with reading(path):
        if not h5py.is_hdf5(path):
            raise FileError(f"{path}: expected an HDF5 file, got something else")
        held = os.stat(path)
        _require_sound_once(os.fspath(path), held.st_ino, held.st_size, held.st_mtime_ns)
        if has_writer(path):
            return open_beside_writer(path)
        return h5py.File(path, "r", rdcc_nbytes=CHUNK_CACHE_BYTES)


@lru_cache(maxsize=16)
def _require_sound_once(path: str, *_: int) -> None:
    """Look through a file's heaps, unless that was done and it is as it was: each reader opens it anew."""
    require_sound_heaps(path)


def require_file(path: PathLike) -> None:
    """Raise `FileError` unless there is an ordinary file at `path`."""
    if not Path(path).is_file():
        got = "a folder or device" if Path(path).exists() else "none"
        raise FileError(f"{path}: expected a file, got {got}")


@contextmanager
def reading(where: PathLike) -> Iterator[None]:
    """Turn what a damaged or unreadable file raises in the block into a `FileError` of one line."""
    try:
        yield
    except Speckle3DError:
        raise
    except _READ_FAILURES as error:
        raise FileError(f"{where}: cannot be read: {one_line(error)}") from error


@contextmanager
def opened(path: PathLike, format_name: str, versions: Sequence[int] = (1,)) -> Iterator[h5py.File]:
    """Open an HDF5 file of the family for reading and require its format and one of the versions."""
    with reading(path), open_hdf5(path) as file:
        found = file_format(file)
        if found != format_name:
            raise InvalidInputError(f"{path}: expected format {format_name!r}, got {found!r}")
        got = read_attribute(file, "version")
        if got not in versions:
            known = " or ".join(map(str, versions))
            raise InvalidInputError(f"{path}: expected {format_name} version {known}, got {got:g}")
        yield file


def hdf5_claim(is_ours: Callable[[h5py.File], bool]) -> Callable[[Path, bytes], bool]:
    """Make a reader's claim of a question about an open HDF5 file; other files are not claimed."""

    def claims(path: Path, start: bytes) -> bool:
        if not start.startswith(SIGNATURE):
            return False
        with reading(path), open_hdf5(path) as file:
            return is_ours(file)

    return claims


def file_format(file: h5py.File) -> str:
    """Return the attribute ``format`` of an open file."""
    return read_text(file, "format")


def has_format(file: h5py.File, name: str) -> bool:
    """Whether an open file is of the family, and of one format."""
    return "format" in file.attrs and file_format(file) == name


def locate(node: Node, name: str = "") -> str:
    """Name a place in a file for a message: ``file: /group/name``."""
    inside = f"{node.name.rstrip('/')}/{name}".rstrip("/") or "/"
    return f"{node.file.filename}: {inside}"


def read_checked(
    group: h5py.Group, name: str, shape: tuple[int | str, ...], dtype: npt.DTypeLike = np.float64
) -> npt.NDArray[Any]:
    """Read a data set whose shape and kind are known.

    Parameters
    ----------
    shape : tuple of int or str
        Lengths; a word stands for a length that is free, and shows in the message.
    dtype : dtype
        What to return. Integers are accepted where floats are asked for, not the other way round.

    Raises
    ------
    InvalidInputError
        If the data set is missing or of another shape or kind.
    FileError
        If its bytes cannot be read.
    """
    node = require_dataset(group, name)
    where, wanted = locate(group, name), np.dtype(dtype)
    if node.dtype.kind not in _ACCEPTED_KINDS[wanted.kind]:
        raise InvalidInputError(f"{where}: expected numbers of type {wanted}, got {node.dtype}")
    if not _fits(node.shape, shape):
        expected = ", ".join(str(n) for n in shape) + ("," if len(shape) == 1 else "")
        raise InvalidInputError(f"{where}: expected shape ({expected}), got {node.shape}")
    with reading(where), naming(where):
        require_readable(node)
        return np.asarray(node[()], dtype=wanted)


def read_rows(group: h5py.Group, name: str, shape: tuple[int | str, ...]) -> npt.NDArray[Any]:
    """Read the first rows of a data set of finite numbers that grows and may be longer.

    Parameters
    ----------
    shape : tuple of int or str
        The first one says how many rows; a word, that all up to the first unwritten one, NaN, are wanted.
    """
    rows = shape[0] if isinstance(shape[0], int) else 0
    node = require_dataset(group, name, rows)
    where = locate(group, name)
    if node.dtype.kind not in "fb" or not _fits(node.shape[1:], shape[1:]) or node.shape[0] < rows:
        raise InvalidInputError(f"{where}: expected shape {shape} or more, got {node.shape} {node.dtype}")
    with reading(where), naming(where):
        require_plausible_rows(node)
        values = np.asarray(node[()], dtype=np.float64 if node.dtype.kind == "f" else np.bool_)
    if isinstance(shape[0], int):
        return values[:rows]
    unwritten = np.flatnonzero(np.isnan(values))
    return values[: unwritten[0]] if unwritten.size else values


def require_dataset(group: h5py.Group, name: str, rows: int | None = None) -> h5py.Dataset:
    """Return a data set of `group` that the file holds whole, or raise `InvalidInputError`.

    Of one that grows, `rows` are to be there.
    """
    node, where = find_member(group, name), locate(group, name)
    if not isinstance(node, h5py.Dataset):
        raise InvalidInputError(f"{where}: expected a data set, got {_kind_of(node)}")
    with reading(where), naming(where):
        require_held(node, rows)
    return node


def has_member(group: h5py.Group, name: str) -> bool:
    """Whether a group holds a name; a link to nothing, or out of the file, is an error and not absence."""
    return find_member(group, name) is not None


def find_group(group: h5py.Group, name: str) -> h5py.Group | None:
    """Return a group inside `group`, None if there is none of that name."""
    return None if find_member(group, name) is None else require_group(group, name)


def require_group(group: h5py.Group, name: str) -> h5py.Group:
    """Return a group inside `group`, or raise `InvalidInputError` naming what is there instead."""
    node = find_member(group, name)
    if not isinstance(node, h5py.Group):
        raise InvalidInputError(f"{locate(group, name)}: expected a group, got {_kind_of(node)}")
    return node


def read_transforms(group: h5py.Group, name: str, count: int) -> RigidTransform:
    """Read a data set of rigid 4x4 matrices."""
    return transforms_from_matrices(read_checked(group, name, (count, 4, 4)), locate(group, name))


def read_texts(group: h5py.Group, name: str, shape: tuple[int, ...]) -> Any:
    """Read a data set of texts of a known shape, as nested lists."""
    node = require_dataset(group, name)
    if h5py.check_string_dtype(node.dtype) is None or node.shape != shape:
        where = locate(group, name)
        raise InvalidInputError(f"{where}: expected texts of shape {shape}, got {node.shape} {node.dtype}")
    with reading(locate(group, name)), naming(locate(group, name)):
        require_readable(node)
        require_texts(node)
        return np.asarray(node.asstr(errors="replace")[()], dtype=object).tolist()


def write_attributes(node: Node, values: object, names: Iterable[str]) -> None:
    """Write attributes of an object by name; of a path that is no Unicode, what can be written."""
    for name in names:
        value = getattr(values, name)
        node.attrs[name] = value.encode("utf-8", "backslashreplace").decode() if type(value) is str else value


def read_attributes(node: Node, kinds: Mapping[str, type]) -> dict[str, Any]:
    """Read attributes into values by name: each a number (`float` or `int`) or a text (`str`)."""
    return {
        name: read_text(node, name) if kind is str else kind(read_attribute(node, name))
        for name, kind in kinds.items()
    }


def read_attribute(node: Node, name: str, default: float | None = None) -> float:
    """Read a finite number; `default` stands in for a missing one unless it is None."""
    if default is not None and name not in node.attrs:
        return default
    return float(read_vector_attribute(node, name, 1)[0])


def read_vector_attribute(node: Node, name: str, size: int) -> FloatArray:
    """Read an attribute of `size` finite numbers as a flat array."""
    where = f"{locate(node)} attribute {name}"
    with reading(where), naming(where):
        raw = plain_attribute(node, name)
    value = np.asarray(raw)
    if value.dtype.kind not in "fiu" or value.size != size or not np.isfinite(value).all():
        raise InvalidInputError(f"{where}: expected {size} finite number(s), got {_shown(raw)}")
    return value.astype(np.float64).ravel()


def read_text(node: Node, name: str) -> str:
    """Read a text attribute."""
    where = f"{locate(node)} attribute {name}"
    with reading(where), naming(where):
        raw = plain_attribute(node, name)
    if isinstance(raw, bytes):
        raw = raw.decode("utf-8", errors="replace")
    if not isinstance(raw, str):
        raise InvalidInputError(f"{where}: expected a text, got {_shown(raw)}")
    return str(raw)


def sha256_of(path: PathLike) -> str:
    """SHA-256 of a file's bytes, read in pieces, as 64 hexadecimal digits."""
    with reading(path), open_regular(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def one_line(error: BaseException) -> str:
    """Return the first line of an error's own words."""
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return (text.strip() or type(error).__name__).splitlines()[0]


def find_member(group: h5py.Group, name: str) -> Any:
    """Return what `group` holds under a name, None if there is none; never of another file."""
    where = locate(group, name)
    with reading(where), naming(where):
        return follow(group, name)


def _fits(shape: tuple[int, ...] | None, expected: tuple[int | str, ...]) -> bool:
    if shape is None or len(shape) != len(expected):
        return False
    return all(isinstance(want, str) or got == want for got, want in zip(shape, expected, strict=True))


def _kind_of(node: object) -> str:
    return "none" if node is None else type(node).__name__.lower()


def _shown(raw: object) -> str:
    text = "none" if raw is None else " ".join(repr(raw).split())
    return text if len(text) <= 60 else f"{text[:57]}..."
