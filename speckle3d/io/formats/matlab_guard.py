"""What a MATLAB file of versions 5 to 7 may not do: unpack far beyond its length, or lie about its parts.

SciPy makes room for what a variable claims, and does not survive some damage: numbers of no known type, or an
imaginary part that is not there. So every element is looked at before, as the format describes it [1]_.

References
----------
.. [1] MathWorks, "MAT-File Format", version 5.
"""

from __future__ import annotations

import io
import math
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import open_regular, plausible_bytes

_HEADER_BYTES, _PIECE_BYTES = 128, 2**20
_MATRIX, _COMPRESSED = 14, 15
_MOST_TIMES_PACKED = 256
"""As of image sequences: an array made in advance and half filled packs well."""
_MOST_LEVELS, _MOST_AXES = 16, 32
_BYTES_OF = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}
"""Of a number, by the type of an element of numbers."""
_TEXT_TYPES = (1, 2, 3, 4, 16, 17, 18)
_CELL, _STRUCT, _CHAR, _SPARSE = 1, 2, 4, 5
_NUMERIC = range(6, 16)
_COMPLEX = 0x08


def require_sound(path: Path) -> None:
    """Refuse a file whose variables are not as the format has them.

    Raises
    ------
    FileError
        Naming the variable's first byte, if it is damaged or truncated.
    InvalidInputError
        If its variables unpack to far more than the file is long.
    """
    with open_regular(path) as stream:
        size = stream.seek(0, 2)
        stream.seek(_HEADER_BYTES - 2)
        order = "<" if stream.read(2) == b"IM" else ">"
        left, at = plausible_bytes(size, _MOST_TIMES_PACKED), _HEADER_BYTES
        while at + 8 <= size:
            where = f"{path}: variable at byte {at}"
            stream.seek(at)
            kind, length = np.frombuffer(stream.read(8), f"{order}u4").tolist()
            if length > size - at - 8:
                held = size - at - 8
                raise FileError(f"{where}: expected {length} bytes, got {held}: truncated")
            if kind == _COMPRESSED:
                unpacked = _unpacked(stream, length, left, where)
                left -= len(unpacked)
                _Walker(io.BytesIO(unpacked), order, where).element(0, len(unpacked), 0)
            else:
                _Walker(stream, order, where).element(at, at + 8 + length, 0)
            at += 8 + length


def _unpacked(stream: BinaryIO, length: int, most: int, where: str) -> bytes:
    unpacker, found = zlib.decompressobj(), bytearray()
    while length > 0 and not unpacker.eof:
        packed = stream.read(min(length, _PIECE_BYTES))
        length -= len(packed)
        while packed:
            found += unpacker.decompress(packed, _PIECE_BYTES)
            if len(found) > most:
                raise InvalidInputError(f"{where}: expected at most {most} bytes unpacked, got more")
            packed = unpacker.unconsumed_tail
    return bytes(found)


class _Walker:
    """Goes through the elements of one variable."""

    def __init__(self, stream: BinaryIO, order: str, where: str) -> None:
        self._stream, self._order, self._where = stream, order, where

    def element(self, at: int, stop: int, level: int) -> int:
        """Look at an array from its tag on; returns where the next element begins."""
        kind, start, length, after = self._tag(at, stop)
        if kind != _MATRIX or level > _MOST_LEVELS:
            raise self._wrong(
                f"an array, up to {_MOST_LEVELS} in each other", f"type {kind} at level {level}"
            )
        if length:
            self._array(start, start + length, level)
        return after

    def _array(self, at: int, stop: int, level: int) -> None:
        flags, at = self._numbers(at, stop, (6,), 2)
        sizes, at = self._numbers(at, stop, (5,), None)
        if not 2 <= len(sizes) <= _MOST_AXES or min(sizes) < 0:
            raise self._wrong("two or more lengths from 0", f"{sizes[:4]}")
        count, kind = math.prod(sizes), flags[0] & 0xFF
        at = self._skip(at, stop, _TEXT_TYPES, None)
        if kind == _STRUCT:
            (longest,), at = self._numbers(at, stop, (5,), 1)
            _, _, length, after = self._tag(at, stop)
            if longest < 1 or length % longest:
                raise self._wrong("names of fields of one length", f"{length} bytes in names of {longest}")
            at, count = after, count * (length // longest)
        if kind in (_STRUCT, _CELL):
            if count * 8 > stop - at:
                raise self._wrong(f"{count} elements", f"{stop - at} bytes")
            for _ in range(count):
                at = self.element(at, stop, level + 1)
        elif kind in _NUMERIC:
            for _ in range(2 if flags[0] >> 8 & _COMPLEX else 1):
                at = self._skip(at, stop, tuple(_BYTES_OF), count)
        elif kind == _CHAR:
            self._skip(at, stop, _TEXT_TYPES, None)
        elif kind == _SPARSE:
            for _ in range(4 if flags[0] >> 8 & _COMPLEX else 3):
                at = self._skip(at, stop, tuple(_BYTES_OF), None)

    def _tag(self, at: int, stop: int) -> tuple[int, int, int, int]:
        """Type of an element, its first byte, its length, and where the next one begins."""
        self._stream.seek(at)
        tag = self._stream.read(8) if at + 8 <= stop else b""
        if len(tag) < 8:
            raise self._wrong("an element", f"its end at byte {at}")
        first, length = np.frombuffer(tag, f"{self._order}u4").tolist()
        if first >> 16:
            kind, start, length, after = first & 0xFFFF, at + 4, first >> 16, at + 8
        else:
            kind, start, after = first, at + 8, at + 8 + length
            after += -length % 8 if kind != _MATRIX else 0
        if start + length > stop or (start == at + 4 and length > 4):
            raise self._wrong(f"{length} bytes", f"{stop - start}")
        return kind, start, length, min(after, stop)

    def _numbers(
        self, at: int, stop: int, kinds: tuple[int, ...], count: int | None
    ) -> tuple[list[int], int]:
        kind, start, length, after = self._tag(at, stop)
        if kind not in kinds or length % 4 or (count is not None and length != 4 * count):
            raise self._wrong(f"numbers of type {kinds[0]}", f"{length} bytes of type {kind}")
        self._stream.seek(start)
        letter = "u" if kind == 6 else "i"
        return np.frombuffer(self._stream.read(length), f"{self._order}{letter}4").tolist(), after

    def _skip(self, at: int, stop: int, kinds: tuple[int, ...], count: int | None) -> int:
        kind, _, length, after = self._tag(at, stop)
        if kind not in kinds:
            raise self._wrong("numbers or letters", f"type {kind}")
        if count is not None and length != count * _BYTES_OF[kind]:
            raise self._wrong(f"{count} numbers of type {kind}", f"{length} bytes")
        return after

    def _wrong(self, expected: str, got: str) -> FileError:
        return FileError(f"{self._where}: expected {expected}, got {got}")
