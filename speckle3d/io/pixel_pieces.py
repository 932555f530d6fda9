"""Pixels of image files piece by piece, in memory that does not grow with their number.

Raw pixels are read where they lie. Packed ones are unpacked from the front; places on the way are kept, at
most `_MOST_PLACES` of some 60 KB each, so that going back costs a bounded part of the file. Pixels packed
with bzip2 have no such places and are unpacked from the start again; those written as text are held in
memory.
"""

from __future__ import annotations

import bz2
import operator
import weakref
import zlib
from dataclasses import dataclass
from io import BufferedReader
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import FileError
from speckle3d.core.files import open_regular
from speckle3d.io.pixels import Pixels, read_pixels

_MOST_PLACES = 64
_PACKED_BYTES = 2**14


class PixelPieces:
    """Pieces of `length` numbers each of an open file; indexing reads one.

    Raises
    ------
    FileError
        On indexing, naming the piece, if the file is damaged or holds fewer bytes than its header said.
    """

    def __init__(self, pixels: Pixels, length: int) -> None:
        self.pixels, self.length = pixels, length
        self._piece_bytes = length * pixels.dtype.itemsize
        self._text = read_pixels(pixels) if pixels.packing == "text" else None
        self._stream = open_regular(pixels.path)
        self._unpacking = _Unpacking(pixels, self._stream, self._piece_bytes)
        # Where nobody closes it, as with frames that a command has done with.
        self._closed = weakref.finalize(self, self._stream.close)

    def __len__(self) -> int:
        return self.pixels.count // self.length

    def __getitem__(self, index: int) -> npt.NDArray[Any]:
        i = operator.index(index)
        if not 0 <= i < len(self):
            raise IndexError(f"piece {i} of {len(self)}")
        if self._text is not None:
            return self._text[i * self.length : (i + 1) * self.length]
        if self.pixels.packing == "raw":
            found = self._raw(i)
        else:
            found = self._unpacking.piece(i, is_last=i == len(self) - 1)
        values = np.frombuffer(found, dtype=self.pixels.dtype)
        return values.astype(self.pixels.dtype.newbyteorder("="), copy=False)

    def close(self) -> None:
        """Close the file."""
        self._closed()

    def _raw(self, i: int) -> bytes:
        self._stream.seek(self.pixels.start + i * self._piece_bytes)
        found = self._stream.read(self._piece_bytes)
        if len(found) != self._piece_bytes:
            raise FileError(
                f"{self.pixels.path}: frame {i}: expected {self._piece_bytes} bytes, got {len(found)}"
            )
        return found


@dataclass
class _Place:
    """Where unpacking stands: the next piece, the position in the file, and what is read but not unpacked."""

    piece: int
    position: int
    unpacker: Any
    packed: bytes

    def copy(self) -> _Place:
        return _Place(self.piece, self.position, self.unpacker.copy(), self.packed)


class _Unpacking:
    def __init__(self, pixels: Pixels, stream: BufferedReader, piece_bytes: int) -> None:
        self._pixels, self._stream, self._piece_bytes = pixels, stream, piece_bytes
        self._step = 1
        self._kept: dict[int, _Place] = {}
        self._now = self._start()

    def _start(self) -> _Place:
        is_deflate = self._pixels.packing == "deflate"
        unpacker = zlib.decompressobj(47) if is_deflate else bz2.BZ2Decompressor()
        return _Place(0, self._pixels.start, unpacker, b"")

    def piece(self, i: int, is_last: bool) -> bytes:
        before = max((place for place in self._kept if place <= i), default=0)
        if self._now.piece > i or before > self._now.piece:
            self._now = self._kept[before].copy() if before in self._kept else self._start()
        while self._now.piece < i:
            self._next()
        found = self._next()
        if is_last and self._take(1):
            raise FileError(f"{self._where(i)}: expected {self._pixels.size_bytes} bytes unpacked, got more")
        return found

    def _next(self) -> bytes:
        self._keep()
        i, found = self._now.piece, self._take(self._piece_bytes)
        if len(found) != self._piece_bytes:
            expected, got = self._pixels.size_bytes, i * self._piece_bytes + len(found)
            self._now = self._start()
            raise FileError(f"{self._where(i)}: expected {expected} bytes unpacked, got {got}")
        self._now.piece += 1
        return found

    def _keep(self) -> None:
        """Remember this place if it is one in `_step`; with too many of them, every other is dropped."""
        i = self._now.piece
        if self._pixels.packing != "deflate" or i % self._step or i in self._kept:
            return
        self._kept[i] = self._now.copy()
        if len(self._kept) > _MOST_PLACES:
            self._step *= 2
            self._kept = {place: kept for place, kept in self._kept.items() if place % self._step == 0}

    def _take(self, count: int) -> bytes:
        """Unpack so many bytes, fewer where the pixels end."""
        now, found = self._now, bytearray()
        try:
            while len(found) < count and not now.unpacker.eof:
                if not now.packed:
                    self._stream.seek(now.position)
                    now.packed = self._stream.read(_PACKED_BYTES)
                    now.position += len(now.packed)
                given, now.packed = now.packed, b""
                piece = now.unpacker.decompress(given, count - len(found))
                now.packed = getattr(now.unpacker, "unconsumed_tail", b"")
                found += piece
                if not (given or piece):
                    break
        except (zlib.error, OSError, EOFError, ValueError) as error:
            self._now = self._start()
            raise FileError(
                f"{self._where(now.piece)}: expected packed pixels, got damaged ones: {error}"
            ) from error
        return bytes(found)

    def _where(self, i: int) -> str:
        return f"{self._pixels.path}: frame {i}"
