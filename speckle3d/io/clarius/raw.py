"""Raw files of Clarius scanners: a header of five numbers, then each frame's time and samples.

Header: five uint32 (id, frames, lines, samples of a line, bytes of a sample); then, by frame, a uint64 time
in nanoseconds and its samples, line by line; all little-endian [1]_. They may be packed by the program lzop,
whose blocks lzallright unpacks [2]_: a packed file is content unpacked in memory while its frames are read.

References
----------
.. [1] clariusdev/research, "Raw Data Format" (docs/raw-data-format.md), ".raw binary layout".
.. [2] M. F. X. J. Oberhumer, lzop 1.04, "File format" (lzop.c, `write_header` and `lzo_compress`).
"""

from __future__ import annotations

import struct
import zlib
from functools import lru_cache
from typing import Any

import numpy as np

from speckle3d.core.arrays import AnyArray, ComplexArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.io.clarius.package import Member
from speckle3d.io.clarius.sidecars import Description
from speckle3d.io.frames import ReadFrame
from speckle3d.io.hdf5 import reading

HEADER = struct.Struct("<5I")
_MAGIC = b"\x89LZO\x00\r\n\x1a\n"
SAMPLES = {"RF": ("<i2", 1, np.int16), "IQ": ("<i2", 2, np.complex64), "envelope": ("u1", 1, np.uint8)}
"""By kind: type of the numbers in the file, how many make a sample, and type of the samples."""


def open_raw(member: Member, yml: Description) -> AnyArray:
    """Frames as they lie in a raw file: ``time`` in ns and ``samples``, shape (line, sample, part).

    Raises
    ------
    FileError
        If the file ends early.
    InvalidInputError
        If its header contradicts the yml.
    """
    content, (dtype, parts, _) = _content(member), SAMPLES[yml.kind]
    size = yml.size.lines, yml.size.samples
    expected = (yml.frames, *size, parts * np.dtype(dtype).itemsize)
    header = HEADER.unpack(bytes(content[: HEADER.size]).ljust(HEADER.size, b"\0"))[1:]
    if header != expected or 0 in header:
        raise InvalidInputError(
            f"{member.where}: header: expected frames, lines, samples and bytes of a sample of {yml.kind} "
            f"as in the yml, {expected}, got {header}"
        )
    record = np.dtype([("time", "<u8"), ("samples", dtype, (*size, parts))])
    whole = (len(content) - HEADER.size) // record.itemsize
    if whole < yml.frames:
        raise FileError(f"{member.where}: ends early: {whole} of {yml.frames} frames")
    return np.frombuffer(content, record, yml.frames, HEADER.size)


def open_frames(member: Member, yml: Description, turns: ComplexArray | None = None) -> ReadFrame:
    """Map or unpack a raw file, whose I/Q are multiplied by `turns`, shape (sample,)."""
    samples = open_raw(member, yml)["samples"]

    def frame(i: int) -> Any:
        parts = samples[i]
        echoes = (parts.astype(np.float32).view(np.complex64) if yml.kind == "IQ" else parts)[..., 0]
        return echoes if turns is None else echoes * turns

    return frame


def _content(member: Member) -> Any:
    """Bytes of a file, unpacked where it is packed by lzop."""
    with reading(member.where):
        if member.name.endswith(".lzo"):
            return _unpack(member, member.path.stat().st_mtime_ns)
        return np.memmap(member.path, np.uint8, "r", member.start, (member.size,))


@lru_cache(1)
def _unpack(member: Member, _: int) -> bytes:
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
        unpacked_size, size, check_sum = struct.unpack(">III", lengths)
        at += 8 + 4 * (plain + (packs if size < unpacked_size else 0))  # behind the check sums
        with reading(f"{member.where}: block {len(parts)}"):
            part = content[at : at + size]
            parts.append(part if size == unpacked_size else bytes(lzo.decompress(part, unpacked_size)))
            if plain and check(parts[-1]) != check_sum:
                raise ValueError("damaged: its check sum is another")
        at += size
    return b"".join(parts)
