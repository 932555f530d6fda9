"""Pixels of MetaImage and NRRD files: where they lie, and reading them in no more memory than they take.

They are read here and not by the image library, which follows any name in a header, out of its folder and to
devices too, and believes any size.
"""

from __future__ import annotations

import bz2
import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import open_regular, plausible_bytes
from speckle3d.io.text import numbers

_MOST_TIMES_PACKED = 256
"""The emptiest recording at hand, of a water tank, unpacks to 73 times its size; deflate can claim 1,032."""

_MOST_LENGTH = 2**40
_PIECE_BYTES = 2**20
_ZLIB_OR_GZIP = 47
"""Told apart by what a stream begins with, in the largest window."""
_GZIP_SIGNATURE = b"\x1f\x8b"

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


def type_of_word(word: str) -> np.dtype[Any]:
    """Type of numbers by MetaImage's word, as MET_SHORT.

    Raises
    ------
    InvalidInputError
    """
    kind = _META_TYPES.get(word.removeprefix("MET_"))
    if kind is None:
        raise InvalidInputError(f"ElementType: expected as MET_SHORT, got {word}")
    return np.dtype(kind)


@dataclass(frozen=True)
class Pixels:
    """Where the pixels of an image file lie, and how.

    Attributes
    ----------
    path : path
        Of the file that holds them: the header's own, or one in its folder.
    start, stored_bytes : int
        First byte, and how many the file holds from there on.
    dtype : dtype
        With its byte order.
    count : int
        Numbers there must be.
    packing : str
        ``"raw"``, ``"deflate"``, ``"bzip2"`` or ``"text"``.
    """

    path: Path
    start: int
    stored_bytes: int
    dtype: np.dtype[Any]
    count: int
    packing: str

    @property
    def size_bytes(self) -> int:
        """Bytes of the numbers in memory."""
        return self.count * self.dtype.itemsize


def meta_pixels(path: Path, fields: Mapping[str, str], size: tuple[int, ...], start: int) -> Pixels:
    """Find the pixels of a MetaImage whose header ends at byte `start`.

    Raises
    ------
    FileError
        If the file holds fewer bytes than the header announces.
    InvalidInputError
        Naming the field that does not make sense.
    """
    where = str(path)
    _, _, word = fields.get("ElementType", "").upper().partition("MET_")
    if word not in _META_TYPES:
        raise InvalidInputError(
            f"{where}: ElementType: expected as MET_SHORT, got {fields.get('ElementType')}"
        )
    order = (
        ">" if any(_flag(fields, name) for name in ("BinaryDataByteOrderMSB", "ElementByteOrderMSB")) else "<"
    )
    packing = "deflate" if _flag(fields, "CompressedData") else "raw"
    if not _flag(fields, "BinaryData", "True"):
        packing = "text"
    count = _count(where, "DimSize", size) * _whole(where, fields, "ElementNumberOfChannels", 1)
    skipped = _whole(where, fields, "HeaderSize", 0)
    name = fields["ElementDataFile"]
    if name in ("LOCAL", "Local", "local"):
        if skipped:
            raise InvalidInputError(f"{where}: HeaderSize: expected 0 where pixels are LOCAL, got {skipped}")
        data = path
    else:
        data, start = _beside(path, name, "ElementDataFile"), skipped
    found = _found(path, data, start)
    announced = _whole(where, fields, "CompressedDataSize", 0)
    dtype = np.dtype(order + _META_TYPES[word])
    return _checked(where, Pixels(data, start, found, dtype, count, packing), announced)


def nrrd_pixels(path: Path, fields: Mapping[str, str], size: tuple[int, ...], start: int) -> Pixels:
    """Find the pixels of an NRRD file whose header ends at byte `start`; `fields` are in small letters.

    Raises
    ------
    FileError
        If the file holds fewer bytes than the header announces.
    InvalidInputError
        Naming the field that does not make sense.
    """
    where = str(path)
    kind, packing = fields.get("type", "").lower(), fields.get("encoding", "").lower()
    if kind not in _NRRD_TYPES:
        raise InvalidInputError(f"{where}: type: expected as uint8, got {kind!r}")
    if packing not in _NRRD_PACKINGS:
        raise InvalidInputError(f"{where}: encoding: expected raw, gzip, bzip2 or text, got {packing!r}")
    order = ">" if fields.get("endian", "").lower() == "big" else "<"
    name = fields.get("data file", fields.get("datafile"))
    data, start = (path, start) if name is None else (_beside(path, name, "data file"), 0)
    for skip in ("line skip", "lineskip", "byte skip", "byteskip"):
        if fields.get(skip, "0") != "0":
            raise InvalidInputError(f"{where}: {skip}: expected 0, got {fields[skip]!r}")
    count = _count(where, "sizes", size)
    dtype = np.dtype(order + _NRRD_TYPES[kind])
    pixels = Pixels(data, start, _found(path, data, start), dtype, count, _NRRD_PACKINGS[packing])
    return _checked(where, pixels, 0)


def read_pixels(pixels: Pixels) -> npt.NDArray[Any]:
    """Read the numbers, shape (count,), in the machine's own byte order.

    Raises
    ------
    FileError
        If the file cannot be read, is damaged, or holds more or fewer.
    """
    _require_plausible(str(pixels.path), pixels)
    with open_regular(pixels.path) as stream:
        stream.seek(pixels.start)
        if pixels.packing == "raw":
            values = np.fromfile(stream, pixels.dtype, pixels.count)
        elif pixels.packing == "text":
            values = _from_text(stream.read(pixels.stored_bytes), pixels)
        else:
            values = _unpacked(stream, pixels).view(pixels.dtype)
    if values.size != pixels.count:
        raise FileError(f"{pixels.path}: expected {pixels.count} pixels, got {values.size}")
    return values.astype(pixels.dtype.newbyteorder("="), copy=False)


class _Stream(Protocol):
    def read(self, size: int, /) -> bytes: ...


def _unpacked(stream: _Stream, pixels: Pixels) -> npt.NDArray[np.uint8]:
    """Unpack piece by piece, never more than one byte beyond what there must be.

    Members of gzip that follow one another, as some tools write them, are one stream.
    """
    unpackers, errors = _unpackers(pixels.packing)
    found = np.empty(pixels.size_bytes, dtype=np.uint8)
    at, packed, unpacker = 0, b"", unpackers()
    try:
        while at < found.size or not unpacker.eof:
            if unpacker.eof:
                packed = unpacker.unused_data or stream.read(_PIECE_BYTES)
                if not packed.startswith(_GZIP_SIGNATURE):
                    break
                unpacker = unpackers()
            packed = packed or stream.read(_PIECE_BYTES)
            piece = unpacker.decompress(packed, min(found.size - at + 1, _PIECE_BYTES))
            if not (packed or piece):
                break
            packed = getattr(unpacker, "unconsumed_tail", b"")
            if at + len(piece) > found.size:
                raise FileError(f"{pixels.path}: expected {found.size} bytes of pixels unpacked, got more")
            found[at : at + len(piece)] = np.frombuffer(piece, dtype=np.uint8)
            at += len(piece)
    except errors as error:
        if isinstance(error, FileError):
            raise
        raise FileError(f"{pixels.path}: expected packed pixels, got damaged ones: {error}") from error
    if at < found.size:
        raise FileError(f"{pixels.path}: expected {found.size} bytes of pixels unpacked, got {at}")
    return found


def _unpackers(packing: str) -> tuple[Callable[[], Any], tuple[type[Exception], ...]]:
    """What makes an unpacker, and the errors it raises; of deflate ISA-L's, faster than zlib's."""
    errors = (zlib.error, OSError, EOFError, ValueError)
    if packing != "deflate":
        return bz2.BZ2Decompressor, errors
    try:
        from isal import isal_zlib
    except ImportError:
        return partial(zlib.decompressobj, _ZLIB_OR_GZIP), errors
    own: Any = isal_zlib.error
    return partial(isal_zlib.decompressobj, _ZLIB_OR_GZIP), (*errors, own)


def _from_text(text: bytes, pixels: Pixels) -> npt.NDArray[Any]:
    try:
        return np.array(text.split(), dtype=np.float64).astype(pixels.dtype)
    except ValueError as error:
        raise FileError(f"{pixels.path}: expected pixels as text, got other bytes") from error


def _checked(where: str, pixels: Pixels, announced: int) -> Pixels:
    """Refuse what the file cannot hold, before room is made for it."""
    least = {"raw": pixels.size_bytes, "text": 2 * pixels.count - 1}.get(pixels.packing, announced)
    if pixels.count and pixels.stored_bytes < least:
        raise FileError(f"{where}: expected {least} bytes of pixels, got {pixels.stored_bytes}: truncated")
    _require_plausible(where, pixels)
    return pixels


def _require_plausible(where: str, pixels: Pixels) -> None:
    most = plausible_bytes(pixels.stored_bytes, _MOST_TIMES_PACKED)
    if pixels.size_bytes > most:
        got = f"{pixels.size_bytes} from {pixels.stored_bytes} packed"
        raise InvalidInputError(f"{where}: expected at most {most} bytes of pixels, got {got}")


_PATTERN_NUMBERS = 2
"""Behind a pattern of files: the first and the last number, and the step."""


def _beside(path: Path, name: str, field: str) -> Path:
    """Path of a data file in the header's folder, symbolic links followed."""
    where = f"{path}: {field}"
    folder = path.parent.resolve()
    first, *more = name.split() or [""]
    if first == "LIST" or ("%" in first and len(more) >= _PATTERN_NUMBERS):
        raise InvalidInputError(
            f"{where}: expected LOCAL or the name of one file, got a list of files ({name!r}), which is not "
            "read: write the images into one file"
        )
    try:
        data = (folder / name).resolve()
    except (OSError, ValueError, RuntimeError) as error:
        raise InvalidInputError(f"{where}: expected the name of a file, got {name!r}") from error
    if not name or Path(name).is_absolute() or not data.is_relative_to(folder):
        raise InvalidInputError(f"{where}: expected a file in the header's own folder, got {name!r}")
    return data


def _found(header: Path, data: Path, start: int) -> int:
    """Bytes that the file of the pixels holds from `start` on; errors name the header that names it."""
    try:
        with open_regular(data) as stream:
            return max(stream.seek(0, 2) - start, 0)
    except FileError as error:
        raise FileError(f"{header}: expected its pixels in a file that is there: {error}") from error


def _count(where: str, field: str, size: tuple[int, ...]) -> int:
    if max(size) > _MOST_LENGTH:
        raise InvalidInputError(
            f"{where}: {field}: expected lengths up to {_MOST_LENGTH}, got {max(size):.3g}"
        )
    return math.prod(size)


def _flag(fields: Mapping[str, str], name: str, default: str = "False") -> bool:
    return fields.get(name, default)[:1] in ("T", "t", "1")


def _whole(where: str, fields: Mapping[str, str], name: str, default: int) -> int:
    (value,) = numbers(fields.get(name, str(default)), 1, f"{where}: {name}")
    if value != int(value) or not 0 <= value <= _MOST_LENGTH:
        raise InvalidInputError(f"{where}: {name}: expected a whole number from 0, got {fields[name]}")
    return int(value)
