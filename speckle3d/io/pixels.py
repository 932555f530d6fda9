"""Pixels of MetaImage and NRRD files as one array, from the disk or unpacked once.

They are read here and not by pynrrd or SimpleITK, which read all of a sequence into memory.
"""

from __future__ import annotations

import bz2
import tempfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import open_regular

_PIECE_BYTES = 2**20
_MEMORY_BYTES = 2**28
"""Unpacked pixels beyond this size are kept in a temporary file."""
_ZLIB_OR_GZIP = 47
"""Window of zlib that tells the two apart by their first bytes."""

_META_TYPES = {
    "CHAR": "i1", "UCHAR": "u1", "SHORT": "i2", "USHORT": "u2", "INT": "i4", "UINT": "u4", "LONG": "i4",
    "ULONG": "u4", "LONG_LONG": "i8", "ULONG_LONG": "u8", "FLOAT": "f4", "DOUBLE": "f8",
}  # fmt: skip
"""By the word behind MET_; a LONG of MetaImage has four bytes."""

_NRRD_WORDS = {
    "i1": "signed char|int8|int8_t",
    "u1": "uchar|unsigned char|uint8|uint8_t",
    "i2": "short|short int|signed short|signed short int|int16|int16_t",
    "u2": "ushort|unsigned short|unsigned short int|uint16|uint16_t",
    "i4": "int|signed int|int32|int32_t",
    "u4": "uint|unsigned int|uint32|uint32_t",
    "i8": "longlong|long long|long long int|signed long long|signed long long int|int64|int64_t",
    "u8": "ulonglong|unsigned long long|unsigned long long int|uint64|uint64_t",
    "f4": "float",
    "f8": "double",
}
_NRRD_TYPES = {word: kind for kind, words in _NRRD_WORDS.items() for word in words.split("|")}
_NRRD_PACKINGS = {
    "raw": "raw", "gz": "deflate", "gzip": "deflate", "bz2": "bzip2", "bzip2": "bzip2",
    "txt": "text", "text": "text", "ascii": "text",
}  # fmt: skip


def meta_type(dtype: np.dtype[Any]) -> str:
    """Word for a type of numbers behind MetaImage's MET_."""
    return next(word for word, kind in _META_TYPES.items() if np.dtype(kind) == dtype.newbyteorder("="))


def nrrd_type(dtype: np.dtype[Any]) -> str:
    """NRRD's word for a type of numbers."""
    return {"float32": "float", "float64": "double"}.get(dtype.name, dtype.name)


@dataclass(frozen=True)
class Pixels:
    """Where the pixels of an image file lie, and how.

    Attributes
    ----------
    path : path
        Of the file that holds them: the header's own, or one in its folder.
    start : int
        First byte; -1 where they are the file's last bytes.
    dtype : dtype
        With its byte order.
    count : int
        Numbers there must be.
    packing : str
        ``"raw"``, ``"deflate"``, ``"bzip2"`` or ``"text"``.
    skipped_lines : int
        Lines of text before the pixels, from `start` on.
    frames : int
        Images that lie one after the other.
    """

    path: Path
    start: int
    dtype: np.dtype[Any]
    count: int
    packing: str
    skipped_lines: int = 0
    frames: int = 1

    @property
    def size_bytes(self) -> int:
        """Bytes of the numbers in memory."""
        return self.count * self.dtype.itemsize

    def ends_early(self, got: int) -> FileError:
        """The error that the file holds so many bytes of pixels, and not all."""
        if self.frames == 1:
            return FileError(f"{self.path}: ends early: {got} of {self.size_bytes} bytes of pixels")
        whole = got * self.frames // self.size_bytes
        return FileError(f"{self.path}: ends early: {whole} of {self.frames} frames")


def meta_pixels(path: Path, fields: Mapping[str, str], count: int, start: int) -> Pixels:
    """Find the pixels of a MetaImage whose header ends at byte `start`.

    Raises
    ------
    InvalidInputError
        Naming the field that does not make sense.
    """
    word = fields.get("ElementType", "").removeprefix("MET_")
    if word not in _META_TYPES and count:
        raise InvalidInputError(f"{path}: ElementType: expected as MET_UCHAR, got {word or 'none'}")
    is_big = any(_flag(fields, name) for name in ("BinaryDataByteOrderMSB", "ElementByteOrderMSB"))
    packing = "deflate" if _flag(fields, "CompressedData") else "raw"
    if not _flag(fields, "BinaryData", "True"):
        packing = "text"
    name = fields["ElementDataFile"]
    skipped = int(fields.get("HeaderSize", "0") or 0)
    is_local = name.upper() == "LOCAL"
    data = path if is_local else _beside(path, name, "ElementDataFile")
    begin = skipped if skipped < 0 or not is_local else start
    dtype = np.dtype((">" if is_big else "<") + _META_TYPES.get(word, "u1"))
    return Pixels(data, begin, dtype, count, packing)


def nrrd_pixels(path: Path, fields: Mapping[str, str], count: int, start: int) -> Pixels:
    """Find the pixels of an NRRD file whose header ends at byte `start`; names of `fields` are lower case.

    Raises
    ------
    InvalidInputError
        Naming the field that does not make sense.
    """
    kind, packing = fields.get("type", "").lower(), fields.get("encoding", "").lower()
    if kind not in _NRRD_TYPES:
        raise InvalidInputError(f"{path}: type: expected as uint8, got {kind!r}")
    if packing not in _NRRD_PACKINGS:
        raise InvalidInputError(f"{path}: encoding: expected raw, gzip, bzip2 or text, got {packing!r}")
    order = ">" if fields.get("endian", "").lower() == "big" else "<"
    name = fields.get("data file", fields.get("datafile"))
    data, start = (path, start) if name is None else (_beside(path, name, "data file"), 0)
    lines, skipped = (
        int(fields.get(f"{what} skip", fields.get(f"{what}skip", "0"))) for what in ("line", "byte")
    )
    begin = -1 if skipped < 0 else start + skipped
    return Pixels(data, begin, np.dtype(order + _NRRD_TYPES[kind]), count, _NRRD_PACKINGS[packing], lines)


def read_pixels(pixels: Pixels) -> npt.NDArray[Any]:
    """Read the numbers into memory, shape (count,), in the machine's byte order; as `map_pixels`."""
    return np.array(map_pixels(pixels))


def map_pixels(pixels: Pixels) -> npt.NDArray[Any]:
    """Map or unpack the numbers, shape (count,); raw ones of the machine's byte order stay on the disk.

    Raises
    ------
    FileError
        If the file cannot be read, is damaged, or holds more or fewer.
    """
    values = _stored(pixels)
    return values.astype(pixels.dtype.newbyteorder("="), copy=False)


def _stored(pixels: Pixels) -> npt.NDArray[Any]:
    """The numbers in the file's byte order."""
    with open_regular(pixels.path) as stream:
        size = stream.seek(0, 2)
        start = size - pixels.size_bytes if pixels.start < 0 else pixels.start
        stream.seek(max(start, 0))
        for _ in range(pixels.skipped_lines):
            stream.readline()
        start = stream.tell()
        if pixels.packing == "text":
            return _from_text(stream.read(), pixels)
        if pixels.packing != "raw":
            return _unpacked(stream, pixels)
    if not 0 <= start <= size - pixels.size_bytes:
        raise pixels.ends_early(size if pixels.start < 0 else max(size - start, 0))
    if not pixels.count:
        return np.zeros(0, pixels.dtype)
    return np.memmap(pixels.path, pixels.dtype, "r", start, (pixels.count,))


def _unpacked(stream: BinaryIO, pixels: Pixels) -> npt.NDArray[Any]:
    """Unpack all, never more than there must be; members of gzip that follow one another are one stream."""
    size, where = pixels.size_bytes, str(pixels.path)
    with tempfile.SpooledTemporaryFile(_MEMORY_BYTES) as room:
        made, packed = 0, b""
        unpacker, damage = _unpacker(pixels)
        try:
            while made <= size:
                if unpacker.eof:
                    packed = unpacker.unused_data or stream.read(_PIECE_BYTES)
                    if packed[:2] != b"\x1f\x8b":
                        break
                    unpacker, _ = _unpacker(pixels)
                packed = packed or stream.read(_PIECE_BYTES)
                piece = unpacker.decompress(packed, _PIECE_BYTES)
                rest = getattr(unpacker, "unconsumed_tail", b"")
                if not piece and rest == packed:
                    break
                packed = rest
                made += room.write(piece)
        except damage as error:
            raise FileError(f"{where}: expected packed pixels, got damaged ones: {error}") from error
        if made < size:
            raise pixels.ends_early(made)
        if made > size:
            raise FileError(f"{where}: expected {size} bytes of pixels unpacked, got more")
        room.seek(0)
        if size <= _MEMORY_BYTES:
            return np.frombuffer(room.read(), pixels.dtype)
        return np.memmap(room._file, pixels.dtype, "r", 0, (pixels.count,))


def _unpacker(pixels: Pixels) -> tuple[Any, tuple[type[Exception], ...]]:
    """What unpacks, and the errors that it raises of damaged bytes."""
    damage = (zlib.error, OSError, EOFError, ValueError)
    if pixels.packing == "bzip2":
        return bz2.BZ2Decompressor(), damage
    try:  # four times as fast as zlib
        from isal import isal_zlib
    except ImportError:
        return zlib.decompressobj(_ZLIB_OR_GZIP), damage
    own: Any = isal_zlib.error
    return isal_zlib.decompressobj(_ZLIB_OR_GZIP), (*damage, own)


def _from_text(text: bytes, pixels: Pixels) -> npt.NDArray[Any]:
    try:
        values = np.array(text.split(), dtype=np.float64).astype(pixels.dtype)
    except ValueError as error:
        raise FileError(f"{pixels.path}: expected pixels as text, got other bytes") from error
    if values.size != pixels.count:
        raise FileError(f"{pixels.path}: expected {pixels.count} pixels, got {values.size}")
    return values


def _beside(path: Path, name: str, field: str) -> Path:
    """Path of a data file, which lies in the header's folder: a stranger's header names no other."""
    where = f"{path}: {field}"
    if name.split()[:1] == ["LIST"] or ("%" in name and len(name.split()) > 1):
        raise InvalidInputError(
            f"{where}: expected LOCAL or the name of one file, got a list of files ({name!r}), which is not "
            "read: write the images into one file"
        )
    folder = path.parent.resolve()
    data = (folder / name).resolve()
    if not name or Path(name).is_absolute() or not data.is_relative_to(folder):
        raise InvalidInputError(f"{where}: expected a file in the header's own folder, got {name!r}")
    return data


def _flag(fields: Mapping[str, str], name: str, default: str = "False") -> bool:
    return fields.get(name, default)[:1] in ("T", "t", "1")
