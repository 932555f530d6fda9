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
from functools import lru_cache
from typing import Any

import numpy as np

from speckle3d.core.arrays import AnyArray, ComplexArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.io.clarius.package import Member
from speckle3d.io.frames import ReadFrame
from speckle3d.io.hdf5 import reading

HEADER = struct.Struct("<5I")
_MAGIC = b"\x89LZO\x00\r\n\x1a\n"
SAMPLES = {"RF": ("<i2", 1, np.int16), "IQ": ("<i2", 2, np.complex64), "envelope": ("u1", 1, np.uint8)}
"""By kind: type of the numbers in the file, how many make a sample, and type of the samples."""


def open_raw(member: Member, kind: str) -> AnyArray:
    """Frames as they lie in a raw file: ``time`` in ns and ``samples``, shape (line, sample, part).

    Raises
    ------
    FileError
        If the file ends early.
    InvalidInputError
        If its samples are of another size than those of the kind.
    """
    content, (dtype, parts, _) = _content(member), SAMPLES[kind]
    _, count, *size, sample_bytes = HEADER.unpack(content[: HEADER.size])
    if sample_bytes != parts * np.dtype(dtype).itemsize:
        raise InvalidInputError(
            f"{member.where}: expected samples of {kind} as in the yml, got some of {sample_bytes} bytes"
        )
    record = np.dtype([("time", "<u8"), ("samples", dtype, (*size, parts))])
    whole = (len(content) - HEADER.size) // record.itemsize
    if whole < count:
        raise FileError(f"{member.where}: ends early: {whole} of {count} frames")
    return np.frombuffer(content, record, count, HEADER.size)


def open_frames(member: Member, kind: str, turns: ComplexArray | None = None) -> ReadFrame:
    """Map or unpack a raw file, whose I/Q are multiplied by `turns`, shape (sample,)."""
    samples = open_raw(member, kind)["samples"]

    def frame(i: int) -> Any:
        parts = samples[i]
        echoes = (parts.astype(np.float32).view(np.complex64) if kind == "IQ" else parts)[..., 0]
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
    while any((lengths := content[at : at + 8].ljust(8, b"\0"))[:4]):
        unpacked_size, size = struct.unpack(">II", lengths)
        at += 8 + 4 * (plain + (packs if size < unpacked_size else 0))  # behind the check sums
        with reading(f"{member.where}: block {len(parts)}"):
            part = content[at : at + size]
            parts.append(part if size == unpacked_size else bytes(lzo.decompress(part, unpacked_size)))
        at += size
    return b"".join(parts)
