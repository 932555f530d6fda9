"""HDF5 files: written whole or not at all, read with errors that name the place."""

import ctypes
import hashlib
import os
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, TypeAlias

import h5py
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import AnyArray, FloatArray
from speckle3d.core.errors import FileError, InvalidInputError, Speckle3DError, naming
from speckle3d.core.files import PathLike as PathLike
from speckle3d.core.files import cannot_write, open_regular, whole_file
from speckle3d.core.geometry import transforms_from_matrices

Node: TypeAlias = h5py.Group | h5py.Dataset
SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""First bytes of an HDF5 file without a user block."""

_HAS_WRITER = ("already open for write", "unable to lock file")
"""HDF5's words for a file that is being written, or whose writer was killed."""

_READ_ATTEMPTS = 20
"""Of what may be half written: a millisecond in all."""

_CHUNK_CACHE_BYTES = 32 * 2**20
"""Room for files whose chunks span several frames."""

_DAMAGE: tuple[type[BaseException], ...] = (
    OSError,
    EOFError,
    KeyError,
    MemoryError,
    OverflowError,
    RuntimeError,
    ValueError,
)
"""What h5py, NumPy and decoders of text raise at damaged data; another error is a bug of ours."""

LABELS_ALONE = ".seg.nrrd"
"""Suffix of labels with their segments, which nothing else may have."""


def atomic_path(path: PathLike) -> AbstractContextManager[Path]:
    """Yield a temporary sibling that becomes `path` when the block succeeds and vanishes when it does not.

    The sibling keeps the suffix, by which some writers choose their format. Siblings that killed processes
    left are removed.

    Raises
    ------
    FileError
        If the folder does not exist, `path` is not an ordinary file, or the system refuses to write.
    """
    return whole_file(require_target(path))


def require_target(path: PathLike) -> Path:
    """Resolve a path and require that a file may be written there; call it before long work, too.

    Raises
    ------
    FileError
        If the folder does not exist or is read-only, or `path` is not an ordinary file.
    """
    target = Path(path).resolve()
    if target.exists() and not target.is_file():
        raise FileError(f"{path}: expected an ordinary file to write, got a folder or device")
    if not target.parent.is_dir() or not os.access(target.parent, os.W_OK):
        raise FileError(f"{path}: expected an existing folder, not read-only, got {target.parent}")
    return target


def require_suffix(path: PathLike, suffixes: Sequence[str]) -> str:
    """Return which of some suffixes a name ends in, which chooses the format.

    Raises
    ------
    InvalidInputError
        If it is none of them.
    """
    name = Path(path).name.lower()
    suffix = next((suffix for suffix in (LABELS_ALONE, *suffixes) if name.endswith(suffix)), "another")
    if suffix not in suffixes:
        raise InvalidInputError(f"{path}: expected a name ending in {', '.join(suffixes)}, got {suffix}")
    return suffix


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


def open_hdf5(path: PathLike) -> h5py.File:
    """Open an HDF5 file for reading, also one that is being written or whose writer was killed.

    Such a file is open in ``swmr_mode``, as by a reader beside a writer.

    Raises
    ------
    FileError
        If it is missing, truncated or not HDF5.
    """
    open_regular(path).close()
    with reading(path):
        try:
            return h5py.File(path, "r", rdcc_nbytes=_CHUNK_CACHE_BYTES)
        except OSError as error:
            if not any(words in str(error) for words in _HAS_WRITER):
                raise
        # What is half written HDF5 reads a hundred times, each after twice the time: for ever in a file that
        # was copied while it grew. h5py has no word for fewer, so HDF5 itself is told.
        access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
        with suppress(OSError, AttributeError):  # Windows does not give away what a library loads
            tell = ctypes.CDLL(h5py.h5p.__file__).H5Pset_metadata_read_attempts
            tell(ctypes.c_int64(access.id), ctypes.c_uint(_READ_ATTEMPTS))
        flags = h5py.h5f.ACC_RDONLY | h5py.h5f.ACC_SWMR_READ
        return h5py.File(h5py.h5f.open(os.fsencode(path), flags, fapl=access))


@contextmanager
def reading(where: PathLike, *more: type[BaseException]) -> Iterator[None]:
    """Turn what a damaged or unreadable file raises in the block into a `FileError` of one line.

    Parameters
    ----------
    more : exceptions
        That a library raises at damage beside those of h5py and NumPy.
    """
    try:
        yield
    except Speckle3DError:
        raise
    except (*_DAMAGE, *more) as error:
        claim = "it claims more than memory holds: " if isinstance(error, MemoryError) else ""
        raise FileError(f"{where}: cannot be read: {claim}{one_line(error)}") from error


@contextmanager
def open_family(path: PathLike, format_name: str, versions: Sequence[int] = (1,)) -> Iterator[h5py.File]:
    """Open an HDF5 file of the family for reading and require its format and one of the versions."""
    with reading(path), open_hdf5(path) as file, naming(str(path)):
        if (kind := file_format(file)) != format_name:
            raise InvalidInputError(f"expected format {format_name!r}, got {kind or 'none'!r}")
        if (version := read_attribute(file, "version")) not in versions:
            raise InvalidInputError(f"expected {format_name} version in {versions}, got {version:g}")
        yield file


def file_format(file: h5py.File) -> str:
    """Kind of a file of the family, by its attribute ``format``; empty of other programs' files."""
    return read_text(file, "format", "")


def locate(node: Node, name: str = "") -> str:
    """Name a place in a file for a message: ``file: /group/name``."""
    inside = f"{node.name.rstrip('/')}/{name}".rstrip("/") or "/"
    return f"{node.file.filename}: {inside}"


def find_member(group: h5py.Group, name: str) -> Any:
    """Return what `group` holds under a name or path, None if there is none.

    Raises
    ------
    InvalidInputError
        If the name leads to another file, or data are in another file.
    """
    where = locate(group, name)
    with reading(where, TypeError):  # h5py refuses types that NumPy lacks
        node = group.get(name) if isinstance(group, h5py.Group) else None
        if node is None or getattr(node, "shape", ()) is None:  # HDF5's data set of nothing
            return None
        is_elsewhere = isinstance(node, h5py.Dataset) and node.dtype and (node.is_virtual or node.external)
        if is_elsewhere or node.file.filename != group.file.filename:
            raise InvalidInputError(f"{where}: expected data in the file itself, got a link out of it")
        return node


def has_member(group: h5py.Group, name: str) -> bool:
    """Whether a group holds a name."""
    return find_member(group, name) is not None


def require_group(group: h5py.Group, name: str) -> h5py.Group:
    """Return a group inside `group`, or raise `InvalidInputError` naming what is there instead."""
    node = find_member(group, name)
    if not isinstance(node, h5py.Group):
        raise InvalidInputError(f"{locate(group, name)}: expected a group, got {node}")
    return node


def require_dataset(group: h5py.Group, name: str, shape: tuple[int | str, ...] | None = None) -> h5py.Dataset:
    """Return a data set of `group`, of a shape in which a word stands for a length that is free.

    Raises
    ------
    InvalidInputError
        If there is none, it is of another shape, or its data are elsewhere.
    """
    node = find_member(group, name)
    if not isinstance(node, h5py.Dataset):
        raise InvalidInputError(f"{locate(group, name)}: expected a data set, got {node}")
    if shape is not None and (
        node.ndim != len(shape)
        or any(n != m and not isinstance(n, str) for n, m in zip(shape, node.shape, strict=True))
    ):
        raise InvalidInputError(f"{locate(group, name)}: expected shape {shape}, got {node.shape}")
    return node


def read_array(
    group: h5py.Group, name: str, shape: tuple[int | str, ...] | None, dtype: npt.DTypeLike = np.float64
) -> AnyArray:
    """Read a data set whose shape and kind are known.

    Parameters
    ----------
    shape : tuple of int or str, or None
        Lengths; a word stands for a length that is free, and shows in the message. None for any shape.
    dtype : dtype
        What to return. Integers are accepted where floats are asked for, not the other way round.

    Raises
    ------
    InvalidInputError
        If the data set is missing or of another shape or kind.
    FileError
        If its bytes cannot be read.
    """
    node, where = require_dataset(group, name, shape), locate(group, name)
    if not np.can_cast(node.dtype, dtype, "same_kind"):
        raise InvalidInputError(f"{where}: expected numbers of type {np.dtype(dtype)}, got {node.dtype}")
    with reading(where):
        return np.asarray(node[()], dtype=dtype)


def read_transforms(group: h5py.Group, name: str, count: int) -> RigidTransform:
    """Read a data set of `count` rigid 4x4 matrices."""
    return transforms_from_matrices(read_array(group, name, (count, 4, 4)), locate(group, name))


def read_texts(group: h5py.Group, name: str, shape: tuple[int, ...] | None) -> Any:
    """Read a data set of texts of a known shape, as nested lists."""
    node = require_dataset(group, name, shape)
    with reading(locate(group, name), TypeError):  # h5py refuses what are no texts
        return np.asarray(node.asstr(errors="replace")[()], dtype=object).tolist()


def _attribute(node: Node, name: str) -> Any:
    with reading(f"{locate(node)} attribute {name}"), suppress(TypeError):  # of a type that NumPy lacks
        return node.attrs.get(name)
    return None


def read_attribute(node: Node, name: str) -> float:
    """Read a number."""
    return float(read_vector_attribute(node, name, 1)[0])


def read_vector_attribute(node: Node, name: str, size: int) -> FloatArray:
    """Read an attribute of `size` numbers, which may be infinite, as a flat array."""
    raw = _attribute(node, name)
    value = np.asarray(raw)
    if value.dtype.kind not in "fiu" or value.size != size or np.isnan(value).any():
        where = f"{locate(node)} attribute {name}"
        raise InvalidInputError(f"{where}: expected {size} number(s), got {raw!r:.60}")
    return value.astype(np.float64).ravel()


def read_text(node: Node, name: str, default: str | None = None) -> str:
    """Read a text, or the first of several; `default` stands in for what is none unless it is None."""
    raw = _attribute(node, name)
    first = next(iter(np.ravel(raw)), None)
    text = first.decode("utf-8", errors="replace") if isinstance(first, bytes) else first
    if not isinstance(text, str) and (text := default) is None:
        raise InvalidInputError(f"{locate(node)} attribute {name}: expected a text, got {raw!r:.60}")
    return str(text)


def sha256_of(path: PathLike) -> str:
    """SHA-256 of a file's bytes, read in pieces, as 64 hexadecimal digits."""
    with reading(path), open_regular(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def one_line(error: BaseException) -> str:
    """Return the first line of an error's own words."""
    text = getattr(error, "strerror", None) or str(error)
    return (text.strip() or type(error).__name__).splitlines()[0]
