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
    """Frames of a raw file.

    Attributes
    ----------
    size : tuple of int
        Frames, lines and samples.
    turns : ndarray, shape (sample,), optional
        Complex factors of the samples, the same in all frames.
    """

    member: Member
    kind: str
    size: tuple[int, int, int]
    turns: ComplexArray | None = None

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the frames."""
        return np.dtype(_SAMPLES[self.kind][2])

    def records(self) -> Any:
        """Frames as they lie in the file: ``time`` in ns and ``samples``, shape (line, sample, part).

        Raises
        ------
        FileError
            If the file ends early.
        """
        dtype, parts, _ = _SAMPLES[self.kind]
        held, (count, lines, samples) = _content(self.member), self.size
        with reading(self.member.where):  # of more samples than memory has places for
            record = np.dtype([("time", "<u8"), ("samples", dtype, (lines, samples, parts))])
        whole = (len(held) - HEADER.size) // record.itemsize
        if whole < count:
            raise FileError(f"{self.member.where}: ends early: {whole} of {count} frames")
        return np.frombuffer(held, record, count, HEADER.size)

    def __call__(self) -> ReadFrame:
        """Map or unpack the file."""
        samples = self.records()["samples"]

        def frame(i: int) -> Any:
            parts = samples[i]
            echoes = (parts.astype(np.float32).view(np.complex64) if self.kind == "IQ" else parts)[..., 0]
            return echoes if self.turns is None else echoes * self.turns

        return frame


def open_raw(member: Member, said: Description) -> ClariusFile:
    """Open a raw file.

    Raises
    ------
    InvalidInputError
        If its header contradicts the yml.
    """
    dtype, parts, _ = _SAMPLES[said.kind]
    size = said.frames, said.size.lines, said.size.samples
    expected = (*size, parts * np.dtype(dtype).itemsize)
    got = HEADER.unpack(bytes(_content(member)[: HEADER.size]).ljust(HEADER.size, b"\0"))[1:]
    if got != expected or 0 in got:
        raise InvalidInputError(
            f"{member.where}: header: expected frames, lines, samples and bytes of a sample of {said.kind} "
            f"as in the yml, {expected}, got {got}"
        )
    return ClariusFile(member, said.kind, size)


def _content(member: Member) -> Any:
    """Bytes of a file, unpacked where it is packed by lzop."""
    with reading(member.where):
        if member.name.endswith(".lzo"):
            return _unpacked(member, member.path.stat().st_mtime_ns)
        return np.memmap(member.path, np.uint8, "r", member.start, (member.size,))


@lru_cache(1)
def _unpacked(member: Member, _: int) -> bytes:
    lzo = extra_module("lzallright", "clarius", "a file packed by lzop (.lzo)").LZOCompressor
    content, parts = member.read(), list[bytes]()
    if not content.startswith(_MAGIC):
        raise FileError(f"{member.where}: expected a file of lzop (.lzo), got another")
    # Behind the versions, the method and the level: flags, a filter, mode, time, the name and a check sum.
    (flags,) = struct.unpack_from(">I", content, 17)
    at = 37 if flags & 0x800 else 33
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
