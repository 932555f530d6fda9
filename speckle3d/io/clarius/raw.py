"""Raw files of Clarius scanners: a header of five numbers, then each frame's time and samples.

Header: five uint32 (id, frames, lines, samples of a line, bytes of a sample); then, by frame, a uint64 time
in nanoseconds and its samples, line by line; all little-endian [1]_. They may be packed by the program lzop,
whose blocks are unpacked by lzallright when they are asked for [2]_.

References
----------
.. [1] clariusdev/research, "Raw Data Format" (docs/raw-data-format.md), ".raw binary layout".
.. [2] M. F. X. J. Oberhumer, lzop 1.04, "File format" (lzop.c, `write_header` and `lzo_compress`).
"""

from __future__ import annotations

import struct
import zlib
from bisect import bisect
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ComplexArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.io.clarius.package import Member
from speckle3d.io.clarius.sidecars import Description
from speckle3d.io.frames import ReadFrame
from speckle3d.io.hdf5 import reading

HEADER = struct.Struct("<5I")
_TIME_BYTES = 8
_MAGIC = b"\x89LZO\x00\r\n\x1a\n"
_KEPT_BLOCKS = 8

_SAMPLES = {"RF": ("<i2", 1), "IQ": ("<i2", 2), "envelope": ("u1", 1)}
"""By kind: type of the numbers in the file, and how many make a sample."""


@dataclass(frozen=True)
class ClariusFile:
    """Frames of a raw file, whose header was checked against its yml.

    Attributes
    ----------
    frames, lines, samples : int
    kept : pair of slice
        Lines and samples kept of each frame.
    turns : ndarray, shape (sample,), optional
        Complex factors of the samples kept, the same in all frames.
    """

    member: Member
    kind: str
    frames: int
    lines: int
    samples: int
    kept: tuple[slice, slice] = (slice(None), slice(None))
    turns: ComplexArray | None = None

    @property
    def sample_bytes(self) -> int:
        """Bytes of a sample."""
        dtype, parts = _SAMPLES[self.kind]
        return np.dtype(dtype).itemsize * parts

    def place(self, i: int) -> int:
        """Byte at which frame i, its time first, begins."""
        return HEADER.size + i * (_TIME_BYTES + self.lines * self.samples * self.sample_bytes)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (frame, vector, sample)."""
        lines, samples = self.kept
        return self.frames, len(range(self.lines)[lines]), len(range(self.samples)[samples])

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the frames."""
        if self.kind == "IQ":
            return np.dtype(np.complex64)
        return np.dtype(np.uint8 if self.kind == "envelope" else np.int16)

    def __call__(self) -> ReadFrame:
        """Open the file."""
        read = open_bytes(self.member)
        dtype, parts = _SAMPLES[self.kind]

        def frame(i: int) -> npt.NDArray[Any]:
            start = self.place(i) + _TIME_BYTES
            content = read(start, self.place(i + 1) - start)
            kept: Any = np.frombuffer(content, dtype).reshape(self.lines, self.samples, parts)[self.kept]
            kept = kept.astype(np.float32).view(np.complex64)[..., 0] if parts == 2 else kept[..., 0]
            return np.asarray(kept if self.turns is None else kept * self.turns)

        return frame


def open_bytes(member: Member) -> Callable[[int, int], bytes]:
    """Open a raw file, packed or not; the function reads bytes from a place on, fewer where they end."""
    return _Unpacker(member).read if member.name.endswith(".lzo") else member.read


def read_header(member: Member, said: Description) -> tuple[ClariusFile, npt.NDArray[np.int64]]:
    """Read the header and the time of every frame, nanoseconds of the scanner's clock.

    Raises
    ------
    FileError
        If the file ends early.
    InvalidInputError
        If the header contradicts the yml.
    """
    read, where = open_bytes(member), member.where
    head = read(0, HEADER.size)
    if len(head) < HEADER.size:
        raise FileError(f"{where}: expected a header of {HEADER.size} bytes, got {len(head)}")
    file = ClariusFile(member, said.kind, said.whole("frames"), said.lines, said.samples)
    size_bytes = said.below("size").whole("sample size", "bytes")
    expected = (file.frames, file.lines, file.samples, size_bytes)
    got = HEADER.unpack(head)[1:]
    if got != expected or size_bytes != file.sample_bytes or 0 in got:
        raise InvalidInputError(
            f"{where}: header: expected frames, lines, samples and bytes of a sample of {said.kind} "
            f"({file.sample_bytes}) as in the yml, {expected}, got {got}"
        )
    whole = sum(len(read(file.place(i + 1) - 1, 1)) for i in range(file.frames))
    if whole < file.frames:
        raise FileError(f"{where}: ends early: {whole} of {file.frames} frames")
    stamps = b"".join(read(file.place(i), _TIME_BYTES) for i in range(file.frames))
    return file, np.frombuffer(stamps, dtype="<u8").astype(np.int64)


class _Unpacker:
    """Reads runs of bytes of a file of lzop; the blocks last used are kept."""

    def __init__(self, member: Member) -> None:
        self._member = member
        self._lzo = extra_module("lzallright", "clarius", "a file packed by lzop (.lzo)").LZOCompressor
        head, at = member.read(0, 1024), len(_MAGIC)
        if not head.startswith(_MAGIC):
            raise FileError(f"{member.where}: expected a file of lzop (.lzo), got another")
        with reading(member.where):
            is_newer = struct.unpack_from(">H", head, at)[0] >= 0x0940
            at += 8 if is_newer else 5
            (flags,) = struct.unpack_from(">I", head, at)
            at += 4 + (4 if flags & 0x800 else 0) + (12 if is_newer else 8)
            at += 1 + head[at] + 4
        plain, packs = (sum(bool(flags & bit) for bit in bits) for bits in ((0x1, 0x100), (0x2, 0x200)))
        self._check = zlib.adler32 if flags & 0x1 else zlib.crc32 if flags & 0x100 else None
        self._firsts, self._blocks, first = list[int](), list[tuple[int, int, int, int]](), 0
        while any((lengths := member.read(at, 12).ljust(12, b"\0"))[:4]):
            unpacked, packed, check = struct.unpack(">III", lengths)
            at += 8 + 4 * (plain + (packs if packed < unpacked else 0))  # behind the check sums
            self._firsts.append(first)
            self._blocks.append((at, packed, unpacked, check))
            first, at = first + unpacked, at + packed
        self._block = lru_cache(_KEPT_BLOCKS)(self._unpacked)

    def read(self, start: int, size: int) -> bytes:
        """Unpack bytes from `start` on, fewer where they end."""
        parts, at = [], start
        for k in range(max(bisect(self._firsts, start) - 1, 0), len(self._blocks)):
            first = self._firsts[k]
            if first >= start + size:
                break
            parts.append(self._block(k)[at - first : start + size - first])
            at += len(parts[-1])
        return b"".join(parts)

    def _unpacked(self, k: int) -> bytes:
        place, packed, unpacked, check = self._blocks[k]
        content = self._member.read(place, packed)
        with reading(f"{self._member.where}: block {k}", Exception):
            plain = content if packed == unpacked else bytes(self._lzo.decompress(content, unpacked))
            if self._check is not None and self._check(plain) != check:
                raise ValueError("damaged: its check sum is another")
        return plain
