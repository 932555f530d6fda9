"""Raw files of Clarius scanners: a header of five numbers, then each frame's time and samples.

Header: five uint32 (id, frames, lines, samples of a line, bytes of a sample); then, by frame, a uint64 time
in nanoseconds and its samples, line by line; all little-endian [1]_. They may be packed by the program lzop,
whose blocks lzallright unpacks [2]_: a packed file is held unpacked in memory while its frames are read.

References
----------
.. [1] clariusdev/research, "Raw Data Format" (docs/raw-data-format.md), ".raw binary layout".
.. [2] M. F. X. J. Oberhumer, lzop 1.04, "File format" (lzop.c, `write_header` and `lzo_compress`).
"""

from __future__ import annotations

import struct
import zlib
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
_MAGIC = b"\x89LZO\x00\r\n\x1a\n"
_SAMPLES = {"RF": ("<i2", 1, np.int16), "IQ": ("<i2", 2, np.complex64), "envelope": ("u1", 1, np.uint8)}
"""By kind: type of the numbers in the file, how many make a sample, and type of the samples."""


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
    def shape(self) -> tuple[int, int, int]:
        """Shape (frame, vector, sample)."""
        lines, samples = self.kept
        return self.frames, len(range(self.lines)[lines]), len(range(self.samples)[samples])

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the frames."""
        return np.dtype(_SAMPLES[self.kind][2])

    def records(self) -> npt.NDArray[Any]:
        """Frames as they lie in the file: ``time`` in ns and ``samples``, shape (line, sample, part).

        Raises
        ------
        FileError
            If the file ends early.
        """
        dtype, parts, _ = _SAMPLES[self.kind]
        member, packed = self.member, unpacked(self.member)
        with reading(member.where):  # of more samples than memory has places for
            record = np.dtype([("time", "<u8"), ("samples", dtype, (self.lines, self.samples, parts))])
        size = member.size if packed is None else len(packed)
        whole = (size - HEADER.size) // record.itemsize
        if whole < self.frames:
            raise FileError(f"{member.where}: ends early: {whole} of {self.frames} frames")
        if packed is not None:
            return np.frombuffer(packed, record, self.frames, HEADER.size)
        return np.memmap(member.path, record, "r", member.start + HEADER.size, (self.frames,))

    def __call__(self) -> ReadFrame:
        """Map or unpack the file."""
        samples = self.records()["samples"]

        def frame(i: int) -> npt.NDArray[Any]:
            part: Any = samples[i][self.kept]
            pairs = part.astype(np.float32).view(np.complex64) if self.kind == "IQ" else part
            return np.asarray(pairs[..., 0] if self.turns is None else pairs[..., 0] * self.turns)

        return frame


def read_header(member: Member, said: Description) -> ClariusFile:
    """Read the header of a raw file.

    Raises
    ------
    InvalidInputError
        If it contradicts the yml.
    """
    packed = unpacked(member)
    head = (member.read(HEADER.size) if packed is None else packed[: HEADER.size]).ljust(HEADER.size, b"\0")
    dtype, parts, _ = _SAMPLES[said.kind]
    expected = (int(said.number("frames")), said.lines, said.samples, parts * np.dtype(dtype).itemsize)
    got = HEADER.unpack(head)[1:]
    if got != expected or 0 in got:
        raise InvalidInputError(
            f"{member.where}: header: expected frames, lines, samples and bytes of a sample of {said.kind} "
            f"as in the yml, {expected}, got {got}"
        )
    return ClariusFile(member, said.kind, *got[:3])


def unpacked(member: Member) -> bytes | None:
    """Content of a file packed by lzop; None of another."""
    if not member.name.endswith(".lzo"):
        return None
    with reading(member.where):
        return _unpacked(member, member.path.stat().st_mtime_ns)


@lru_cache(1)
def _unpacked(member: Member, _: int) -> bytes:
    lzo = extra_module("lzallright", "clarius", "a file packed by lzop (.lzo)").LZOCompressor
    content, at, parts = member.read(), len(_MAGIC), list[bytes]()
    if not content.startswith(_MAGIC):
        raise FileError(f"{member.where}: expected a file of lzop (.lzo), got another")
    is_newer = struct.unpack_from(">H", content, at)[0] >= 0x0940
    at += 8 if is_newer else 5
    (flags,) = struct.unpack_from(">I", content, at)
    at += 4 + (4 if flags & 0x800 else 0) + (12 if is_newer else 8)
    at += 1 + content[at] + 4
    plain, packs = (sum(bool(flags & bit) for bit in bits) for bits in ((0x1, 0x100), (0x2, 0x200)))
    check = zlib.adler32 if flags & 0x1 else zlib.crc32
    while any((lengths := content[at : at + 12].ljust(12, b"\0"))[:4]):
        unpacked_size, size, said = struct.unpack(">III", lengths)
        at += 8 + 4 * (plain + (packs if size < unpacked_size else 0))  # behind the check sums
        with reading(f"{member.where}: block {len(parts)}", Exception):
            part = content[at : at + size]
            parts.append(part if size == unpacked_size else bytes(lzo.decompress(part, unpacked_size)))
            if plain and check(parts[-1]) != said:
                raise ValueError("damaged: its check sum is another")
        at += size
    return b"".join(parts)
