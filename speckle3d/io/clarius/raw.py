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
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ComplexArray, FloatArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.io.clarius.package import Member
from speckle3d.io.clarius.sidecars import Curve, Description
from speckle3d.io.frames import ReadFrame

HEADER = struct.Struct("<5I")
_TIME_BYTES = 8
_MAGIC = b"\x89LZO\x00\r\n\x1a\n"
_KEPT_BLOCKS = 8

_SAMPLES = {"RF": ("<i2", 1), "IQ": ("<i2", 2), "envelope": ("u1", 1)}
"""By kind: type of the numbers in the file, and how many make a sample."""


@dataclass(frozen=True)
class RawHeader:
    """What a raw file says of itself, checked against its yml."""

    frames: int
    lines: int
    samples: int
    sample_bytes: int

    @property
    def step_bytes(self) -> int:
        """Bytes from frame to frame."""
        return _TIME_BYTES + self.lines * self.samples * self.sample_bytes


def open_bytes(member: Member) -> Callable[[int, int], bytes]:
    """Open a raw file, packed or not; the function reads bytes from a place on, fewer where they end."""
    return _Unpacker(member).read if member.name.endswith(".lzo") else member.read


def read_header(member: Member, said: Description) -> tuple[RawHeader, npt.NDArray[np.int64]]:
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
    header = RawHeader(*HEADER.unpack(head)[1:])
    _, parts = _SAMPLES[said.kind]
    size = np.dtype(_SAMPLES[said.kind][0]).itemsize * parts
    for name, expected, got in (
        ("frames", said.frames, header.frames),
        ("number of lines", said.lines, header.lines),
        ("samples per line", said.samples, header.samples),
        ("sample size", said.sample_bytes, header.sample_bytes),
        (f"bytes of a sample of type {said.kind}", size, header.sample_bytes),
    ):
        if expected != got:
            raise InvalidInputError(f"{where}: header: expected {name} {expected} as in the yml, got {got}")
    if 0 in (header.frames, header.lines, header.samples):
        raise InvalidInputError(f"{where}: expected frames of lines and samples, got {header}")
    stamps = [read(HEADER.size + i * header.step_bytes, _TIME_BYTES) for i in range(header.frames)]
    ends = [HEADER.size + (i + 1) * header.step_bytes - 1 for i in range(header.frames)]
    if not read(ends[-1], 1):
        whole = sum(len(read(end, 1)) for end in ends)
        raise FileError(f"{where}: ends early: {whole} of {header.frames} frames")
    return header, np.frombuffer(b"".join(stamps), dtype="<u8").astype(np.int64)


@dataclass(frozen=True)
class ClariusFile:
    """Opens the frames of a raw file.

    Attributes
    ----------
    lines, samples : slice
        Kept of each frame.
    turns : ndarray, shape (sample,), optional
        Complex factors of the samples kept, the same in all frames.
    gain : Gain, optional
        By which frames differ.
    """

    member: Member
    header: RawHeader
    kind: str
    lines: slice
    samples: slice
    turns: ComplexArray | None = None
    gain: Gain | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (frame, vector, sample)."""
        header = self.header
        kept = len(range(header.lines)[self.lines]), len(range(header.samples)[self.samples])
        return header.frames, *kept

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the frames."""
        if self.kind == "IQ":
            return np.dtype(np.complex64)
        return np.dtype(np.float32 if self.gain else np.uint8 if self.kind == "envelope" else np.int16)

    def __call__(self) -> ReadFrame:
        """Open the file."""
        read, header = open_bytes(self.member), self.header
        dtype, parts = _SAMPLES[self.kind]

        def frame(i: int) -> npt.NDArray[Any]:
            start = HEADER.size + i * header.step_bytes + _TIME_BYTES
            content = read(start, header.step_bytes - _TIME_BYTES)
            if len(content) < header.step_bytes - _TIME_BYTES:
                raise FileError(f"{self.member.where}: ends early: {i} of {header.frames} frames")
            values = np.frombuffer(content, dtype).reshape(header.lines, header.samples, parts)
            kept: npt.NDArray[Any] = values[self.lines, self.samples]
            kept = kept.astype(np.float32).view(np.complex64)[..., 0] if parts == 2 else kept[..., 0]
            if self.turns is not None:
                kept = kept * self.turns
            return kept if self.gain is None else kept * self.gain.factors(i)

        return frame


@dataclass(frozen=True)
class Gain:
    """Gain that differs between frames.

    Attributes
    ----------
    depth_mm : ndarray, shape (sample,)
    curves : tuple of Curve
        Of each frame.
    """

    depth_mm: FloatArray
    curves: tuple[Curve, ...]

    def factors(self, i: int) -> FloatArray:
        """The first frame's gain over that of frame i, shape (sample,)."""
        return np.asarray(10.0 ** ((self._db(self.curves[0]) - self._db(self.curves[i])) / 20.0))

    def _db(self, curve: Curve) -> FloatArray:
        return np.asarray(np.interp(self.depth_mm, *np.array(curve).T))


class _Unpacker:
    """Reads runs of bytes of a file of lzop; the blocks last used are kept."""

    def __init__(self, member: Member) -> None:
        self._member = member
        self._lzo = extra_module("lzallright", "clarius", "a file packed by lzop (.lzo)")
        self._blocks: list[tuple[int, int, int, int, bytes]] = []  # first byte, place, lengths, check sum
        at, self._flags = self._header()
        plain, packs = (sum(bool(self._flags & bit) for bit in bits) for bits in ((0x1, 0x100), (0x2, 0x200)))
        first = 0
        while True:
            lengths = member.read(at, 8).ljust(8, b"\0")
            unpacked, packed = struct.unpack(">II", lengths)
            if not unpacked:
                break
            check = member.read(at + 8, 4)
            at += 8 + 4 * (plain + (packs if packed < unpacked else 0))
            self._blocks.append((first, at, packed, unpacked, check))
            first, at = first + unpacked, at + packed
        self._firsts = np.array([block[0] for block in self._blocks])
        self._block = lru_cache(_KEPT_BLOCKS)(self._unpacked)

    def read(self, start: int, size: int) -> bytes:
        """Unpack bytes from `start` on, fewer where they end."""
        k = max(int(np.searchsorted(self._firsts, start, "right")) - 1, 0)
        parts, at = [], start
        while at < start + size and k < len(self._blocks):
            first = self._blocks[k][0]
            part = self._block(k)[at - first : start + size - first]
            parts.append(part)
            at, k = at + len(part), k + 1
            if not part:
                break
        return b"".join(parts)

    def _unpacked(self, k: int) -> bytes:
        _, place, packed, unpacked, check = self._blocks[k]
        content, where = self._member.read(place, packed), f"{self._member.where}: block {k}"
        plain = content
        if packed != unpacked:
            try:
                plain = bytes(self._lzo.LZOCompressor.decompress(content, unpacked))
            except (self._lzo.LZOError, ValueError, MemoryError) as error:
                raise FileError(f"{where}: expected packed bytes, got damaged ones: {error}") from error
        method = zlib.adler32 if self._flags & 0x1 else zlib.crc32
        is_right = not self._flags & 0x101 or struct.pack(">I", method(plain)) == check
        if len(plain) != unpacked or not is_right:
            raise FileError(f"{where}: expected {unpacked} bytes unpacked, got damaged ones")
        return plain

    def _header(self) -> tuple[int, int]:
        """Place of the first block, and the flags, which say which check sums there are."""
        head = self._member.read(0, 1024)
        if not head.startswith(_MAGIC):
            raise FileError(f"{self._member.where}: expected a file of lzop (.lzo), got another")
        try:
            at = len(_MAGIC)
            is_newer = struct.unpack_from(">H", head, at)[0] >= 0x0940
            at += 8 if is_newer else 5
            (flags,) = struct.unpack_from(">I", head, at)
            at += 4 + (4 if flags & 0x800 else 0) + (12 if is_newer else 8)
            return at + 1 + head[at] + 4, flags
        except (struct.error, IndexError):
            raise FileError(f"{self._member.where}: header: ends early") from None
