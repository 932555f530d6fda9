"""Volumes written plane by plane, as NRRD, MetaImage or NIfTI files, in memory that stays as it is."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InvalidInputError, MismatchError, naming
from speckle3d.core.files import PathLike
from speckle3d.core.labels import Segment, require_segments
from speckle3d.core.threads import ahead, cores
from speckle3d.io.deflate import LAST_BLOCK, ZLIB_START, packed_run
from speckle3d.io.hdf5 import atomic_path
from speckle3d.io.header_text import put_packed_size
from speckle3d.io.voxels.nifti import nifti_header
from speckle3d.io.voxels.segments import segment_fields
from speckle3d.io.voxels.volume_headers import VolumeHeader, meta_header, nrrd_header

SUFFIXES = (".nrrd", ".mha", ".nii.gz", ".nii")
"""Of files that are written; .seg.nrrd is one of them, for labels alone."""

LABELS_ALONE = ".seg.nrrd"

_PIECE_BYTES = 2**20
"""Bytes that are packed at once: the same for any number of threads, so that files are the same, too."""
_BATCH_BYTES = 16 * _PIECE_BYTES

_GZIP_START = b"\x1f\x8b\x08" + bytes(6) + b"\xff"
"""Of a gzip file without name and time, of an unknown system."""


class VolumeWriter:
    """Writes a volume in a block; the file appears whole when the block ends, or not at all.

    World axes are written as left, posterior, superior, in mm: NRRD says so, MetaImage means it, and NIfTI
    has the first two reversed (right, anterior, superior). Numbers are little-endian.

    Parameters
    ----------
    path : path
        With a suffix of `SUFFIXES`.
    shape : tuple of int
        Number of voxels along i, j and k.
    spacing_mm : tuple of float
        Distance between neighbouring voxel centres along i, j and k.
    world_from_grid : RigidTransform
        Pose of the grid; its origin is the centre of voxel ``[0, 0, 0]``; mm.
    dtype : dtype
        uint8, int16, uint16 or float32.
    fields : mapping of str to str, optional
        What the file says of the voxels; `read_volume` gives it back.
    compress : bool
        Whether voxels are packed with deflate; of .nii.gz, they always are, of .nii never.
    segments : sequence of Segment, optional
        What labels mean; voxels are labels if this is given, even if it is empty.

    Raises
    ------
    InvalidInputError
        If an argument is not what it must be, naming the file.
    FileError
        If the file cannot be written; `NoSpaceError` if the disk is full.

    Examples
    --------
    >>> import tempfile
    >>> from speckle3d.io.voxels.volumes import read_volume
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = f"{folder}/v.nrrd"
    ...     with VolumeWriter(file, (4, 3, 2), (1, 1, 1), RigidTransform.identity(), "uint8") as writer:
    ...         for k in range(2):
    ...             writer.append(np.full((1, 3, 4), k, np.uint8))
    ...     read_volume(file).voxels[0, 0].tolist()
    [0, 1]
    """

    def __init__(
        self,
        path: PathLike,
        shape: tuple[int, int, int],
        spacing_mm: tuple[float, float, float],
        world_from_grid: RigidTransform,
        dtype: npt.DTypeLike,
        fields: Mapping[str, str] | None = None,
        compress: bool = True,
        segments: Sequence[Segment] | None = None,
    ) -> None:
        self._path = Path(path)
        suffix = require_suffix(self._path, segments is not None)
        with naming(str(path)):
            kind, plain = np.dtype(dtype).newbyteorder("="), dict[str, str]()
            if segments is not None:
                require_segments(kind, tuple(segments))
                plain = segment_fields(segments, shape)
            self._header = VolumeHeader(shape, spacing_mm, world_from_grid, kind, fields or {}, plain)
            self._packs = suffix == ".nii.gz" or (compress and suffix != ".nii")
            self._text = _header_bytes(self._header, suffix, self._packs, segments is not None)
        self._is_meta = suffix == ".mha"
        self._stored = kind.newbyteorder("<")
        self._planes = 0
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            part = stack.enter_context(atomic_path(self._path))
            self._file = stack.enter_context(part.open("wb"))
            stack.push(self._finish_unless)
            is_gzip = self._path.name.lower().endswith(".gz")
            if not is_gzip:
                self._file.write(self._text)
            self._voxels = _Packed(self._file, not self._is_meta) if self._packs else _Raw(self._file)
            if is_gzip:
                self._voxels.write(self._text)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def append(self, planes: npt.NDArray[Any]) -> None:
        """Write the next planes along k.

        Parameters
        ----------
        planes : ndarray, shape (k, j, i)
            Of the volume's type, in any order in memory.

        Raises
        ------
        MismatchError
            If they are of another shape or type, or more than are left.
        FileError
            If the file cannot be written.
        """
        n_i, n_j, n_k = self._header.shape
        left = n_k - self._planes
        if planes.ndim != 3 or planes.shape[1:] != (n_j, n_i) or len(planes) > left:
            expected = f"at most {left} planes of {n_j} x {n_i} voxels (j x i)"
            raise MismatchError(f"{self._path}: expected {expected}, got shape {planes.shape}")
        if planes.dtype.newbyteorder("=") != self._header.dtype:
            raise MismatchError(
                f"{self._path}: expected voxels of type {self._header.dtype}, got {planes.dtype}"
            )
        step = max(1, _BATCH_BYTES // (n_i * n_j * self._stored.itemsize))
        for first in range(0, len(planes), step):
            some = np.ascontiguousarray(planes[first : first + step], dtype=self._stored)
            self._voxels.write(some.data.cast("B"))
        self._planes += len(planes)

    def _finish_unless(self, _: object, error: BaseException | None, __: object) -> None:
        if error is None:
            self._finish()

    def _finish(self) -> None:
        expected = self._header.shape[2]
        if self._planes != expected:
            raise MismatchError(f"{self._path}: expected {expected} planes, got {self._planes}")
        size = self._voxels.finish()
        if self._is_meta and self._packs:
            put_packed_size(self._file, self._text, size)


class _Raw:
    """Bytes as they are."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def write(self, data: bytes | memoryview) -> None:
        self._file.write(data)

    def finish(self) -> int:
        return 0


class _Packed:
    """Bytes in one stream of deflate whose blocks are packed in threads: gzip's, or zlib's."""

    def __init__(self, file: BinaryIO, is_gzip: bool) -> None:
        self._file, self._is_gzip = file, is_gzip
        self._waiting = bytearray()
        self._check, self._sum = (_crc32(), 0) if is_gzip else (zlib.adler32, 1)
        self._given = 0
        self._size = file.write(_GZIP_START if is_gzip else ZLIB_START)

    def write(self, data: bytes | memoryview) -> None:
        self._sum = self._check(data, self._sum)
        self._given += len(data)
        self._waiting += data
        if len(self._waiting) >= _BATCH_BYTES:
            whole = len(self._waiting) // _PIECE_BYTES * _PIECE_BYTES
            self._pack(whole)

    def finish(self) -> int:
        """Write what still waits, and the check sum; returns the bytes of the whole stream."""
        self._pack(len(self._waiting))
        if self._is_gzip:
            end = struct.pack("<2I", self._sum, self._given & 0xFFFFFFFF)
        else:
            end = struct.pack(">I", self._sum)
        return self._size + self._file.write(LAST_BLOCK + end)

    def _pack(self, stop: int) -> None:
        # Blocks are written in order, while others pack those behind them.
        for packed in ahead(packed_run, self._pieces(stop), most=2 * cores()):
            self._size += self._file.write(packed)
        del self._waiting[:stop]

    def _pieces(self, stop: int) -> Iterator[bytes]:
        for first in range(0, stop, _PIECE_BYTES):
            yield bytes(self._waiting[first : min(first + _PIECE_BYTES, stop)])


def _crc32() -> Callable[[bytes | memoryview, int], int]:
    """Function of gzip's check sum: ISA-L's, or zlib's where it is missing."""
    try:
        from isal import isal_zlib
    except ImportError:
        return zlib.crc32
    found: Callable[[bytes | memoryview, int], int] = isal_zlib.crc32
    return found


def require_suffix(path: Path, is_labels: bool = False) -> str:
    """Suffix of a volume's name, which chooses the format.

    Raises
    ------
    InvalidInputError
        If it is none of `SUFFIXES`, or is of labels where there are none.
    """
    name = path.name.lower()
    suffix = next((each for each in SUFFIXES if name.endswith(each)), None)
    if suffix is None:
        raise InvalidInputError(f"{path}: expected a name ending in {', '.join(SUFFIXES)}")
    if name.endswith(LABELS_ALONE) and not is_labels:
        raise InvalidInputError(
            f"{path}: {LABELS_ALONE} is of labels with their segments: take another name ending in .nrrd"
        )
    return suffix


def _header_bytes(header: VolumeHeader, suffix: str, is_packed: bool, is_labels: bool) -> bytes:
    if suffix == ".nrrd":
        return nrrd_header(header, "gzip" if is_packed else "raw")
    return meta_header(header, is_packed) if suffix == ".mha" else nifti_header(header, is_labels)
