"""Pixels of MetaImage and NRRD files as one array, mapped from the disk or unpacked.

They are read here and not by pynrrd, which reads all of a raw sequence into memory, drops letters beyond
ASCII (names of segments, micrometres) and stops at the first member of packed pixels; nor by SimpleITK,
for which frames have no fields.
"""

from __future__ import annotations

import bz2
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import open_regular
from speckle3d.io.deflate import DAMAGE, unpacker

_WORDS = {
    "i1": "char int8",
    "u1": "uchar uint8",
    "i2": "short int16",
    "u2": "ushort uint16",
    "i4": "int long int32",
    "u4": "uint ulong uint32",
    "i8": "long_long longlong int64",
    "u8": "ulong_long ulonglong uint64",
    "f4": "float",
    "f8": "double",
}
"""Types of numbers: first as MetaImage writes them, whose LONG has four bytes, last as NRRD does."""


def meta_type(dtype: np.dtype[Any]) -> str:
    """Word for a type of numbers behind MetaImage's MET_."""
    return _WORDS[dtype.newbyteorder("=").str[1:]].split()[0].upper()


def nrrd_type(dtype: np.dtype[Any]) -> str:
    """NRRD's word for a type of numbers."""
    return _WORDS[dtype.newbyteorder("=").str[1:]].split()[-1]


def number_type(word: str, is_big: bool, where: str) -> np.dtype[Any]:
    """Type of numbers by a word of either format, as ``MET_UCHAR`` or ``unsigned char``.

    Raises
    ------
    InvalidInputError
        If there is none of that name.
    """
    plain = word.lower().removeprefix("met_").removesuffix("_t").replace("unsigned ", "u")
    plain = plain.replace("signed ", "").removesuffix(" int").replace(" ", "")
    for kind, words in _WORDS.items():
        if plain in words.split():
            return np.dtype((">" if is_big else "<") + kind)
    raise InvalidInputError(f"{where}: expected a type of numbers as uint8 or MET_UCHAR, got {word!r}")


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


def map_pixels(pixels: Pixels) -> npt.NDArray[Any]:
    """Map or unpack the numbers, shape (count,); raw ones of the machine's byte order stay on the disk.

    Raises
    ------
    FileError
        If the file cannot be read, is damaged, or holds more or fewer.
    """
    with open_regular(pixels.path) as stream:
        size = stream.seek(0, 2)
        stream.seek(max(size - pixels.size_bytes, 0) if pixels.start < 0 else pixels.start)
        for _ in range(pixels.skipped_lines):
            stream.readline()
        start = stream.tell()
        packed = b"" if pixels.packing == "raw" else stream.read()
    if pixels.packing != "raw":
        values = (_from_text if pixels.packing == "text" else _unpacked)(packed, pixels)
    elif start + pixels.size_bytes > size:
        raise pixels.ends_early(max(size - start, 0))
    elif pixels.count:
        values = np.memmap(pixels.path, pixels.dtype, "r", start, (pixels.count,))
    else:
        values = np.zeros(0, pixels.dtype)
    return values.astype(pixels.dtype.newbyteorder("="), copy=False)


def _unpacked(packed: bytes, pixels: Pixels) -> npt.NDArray[Any]:
    """Unpack all, never more than there must be; members of gzip that follow one another are one stream."""
    size, content = pixels.size_bytes, bytearray()
    try:
        while packed and len(content) <= size:
            stream = bz2.BZ2Decompressor() if pixels.packing == "bzip2" else unpacker()
            content += stream.decompress(packed, size + 1 - len(content))
            packed = stream.unused_data if stream.unused_data[:2] == b"\x1f\x8b" else b""
    except DAMAGE as error:
        raise FileError(f"{pixels.path}: expected packed pixels, got damaged ones: {error}") from error
    if len(content) < size:
        raise pixels.ends_early(len(content))
    if len(content) > size:
        raise FileError(f"{pixels.path}: expected {size} bytes of pixels unpacked, got more")
    return np.frombuffer(content, pixels.dtype)


def _from_text(text: bytes, pixels: Pixels) -> npt.NDArray[Any]:
    values = np.array(text.split(), dtype=np.float64).astype(pixels.dtype)
    if values.size != pixels.count:
        raise FileError(f"{pixels.path}: expected {pixels.count} pixels, got {values.size}")
    return values
