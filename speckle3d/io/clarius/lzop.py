"""Files of the program lzop: any run of their bytes, unpacked block by block.

The blocks' headers are read once; a block is unpacked when it is asked for, and its checksums are compared.

References
----------
.. [1] M. F. X. J. Oberhumer, lzop 1.04, "File format" (lzop.c, `write_header` and `lzo_compress`).
"""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from io import BufferedReader
from typing import Any, TypeAlias

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.core.files import open_regular
from speckle3d.io.clarius.package import Member
from speckle3d.io.hdf5 import reading

MAGIC = b"\x89LZO\x00\r\n\x1a\n"

_Checks: TypeAlias = tuple[tuple[int, Callable[[bytes], int]], ...]

_CHECKS_OF_UNPACKED: _Checks = ((0x1, zlib.adler32), (0x100, zlib.crc32))
_CHECKS_OF_PACKED: _Checks = ((0x2, zlib.adler32), (0x200, zlib.crc32))
_EXTRA_FIELD, _FILTERED, _MULTIPART, _HEADER_CRC32 = 0x40, 0x800, 0x400, 0x1000
_NEWER_HEADER = 0x0940
_LZO1X = (1, 2, 3)

_MOST_BLOCK_BYTES = 2**20
"""Lzop writes blocks of 256 KiB; a damaged one of this length unpacks to at most 255 times as much."""

_KEPT_BLOCKS = 8


@dataclass(frozen=True)
class Block:
    """One block: where its bytes are, how long it is packed and unpacked, and its checksums."""

    start: int
    packed_bytes: int
    unpacked_bytes: int
    checks_of_unpacked: tuple[int, ...]
    checks_of_packed: tuple[int, ...]


@dataclass(frozen=True)
class Index:
    """Blocks of an lzop file and the first unpacked byte of each.

    Attributes
    ----------
    flags : int
        Say which checksums there are.
    """

    flags: int
    blocks: tuple[Block, ...]
    firsts: tuple[int, ...]
    size: int


class Unpacker:
    """Reads runs of bytes of a member that is packed; the blocks last used are kept."""

    def __init__(self, member: Member) -> None:
        self._member = member
        self._unpacked: OrderedDict[int, bytes] = OrderedDict()

    @cached_property
    def _index(self) -> Index:
        with reading(self._member.where), open_regular(self._member.path) as stream:
            return read_index(self._member, stream)

    @property
    def size(self) -> int:
        """Bytes, unpacked."""
        return self._index.size

    def read(self, start: int, size: int) -> bytes:
        """Unpack bytes from `start` on.

        Raises
        ------
        FileError
            Naming the block that is damaged.
        """
        index, stop = self._index, start + size
        if stop > index.size:
            raise FileError(f"{self._member.where}: expected {stop} bytes unpacked, got {index.size}")
        first, last = bisect_right(index.firsts, start) - 1, bisect_left(index.firsts, stop)
        parts = [self._block(i) for i in range(first, last)]
        parts[-1] = parts[-1][: stop - index.firsts[last - 1]]
        parts[0] = parts[0][start - index.firsts[first] :]
        return b"".join(parts)

    def _block(self, i: int) -> bytes:
        if i not in self._unpacked:
            block, where = self._index.blocks[i], f"{self._member.where}: block {i}"
            with reading(where), open_regular(self._member.path) as stream:
                stream.seek(block.start)
                packed = stream.read(block.packed_bytes)
            self._unpacked[i] = unpack(packed, block, self._index.flags, where)
            if len(self._unpacked) > _KEPT_BLOCKS:
                self._unpacked.popitem(last=False)
        self._unpacked.move_to_end(i)
        return self._unpacked[i]


def read_index(member: Member, stream: BufferedReader) -> Index:
    """Read where the blocks of an lzop file are.

    Raises
    ------
    FileError
        If it is truncated or damaged.
    InvalidInputError
        If it is packed in another way.
    """
    flags, at = _read_header(member, stream)
    stop = member.start + member.size
    unpacked_checks = sum(bool(flags & bit) for bit, _ in _CHECKS_OF_UNPACKED)
    packed_checks = sum(bool(flags & bit) for bit, _ in _CHECKS_OF_PACKED)
    blocks: list[Block] = []
    firsts: list[int] = []
    size = 0
    while True:
        stream.seek(at)
        head = stream.read(min(24, stop - at))
        if len(head) < 4:
            raise FileError(f"{member.where}: expected an end after block {len(blocks)}, got none: truncated")
        (unpacked,) = struct.unpack_from(">I", head)
        if unpacked == 0:
            return Index(flags, tuple(blocks), tuple(firsts), size)
        where = f"{member.where}: block {len(blocks)}"
        packed = struct.unpack_from(">I", head.ljust(24, b"\0"), 4)[0]
        if unpacked > _MOST_BLOCK_BYTES or not 0 < packed <= unpacked:
            raise FileError(
                f"{where}: expected at most {_MOST_BLOCK_BYTES} bytes, packed in fewer, got {unpacked} in "
                f"{packed}"
            )
        checks = unpacked_checks + (packed_checks if packed < unpacked else 0)
        start = at + 8 + 4 * checks
        if start + packed > stop:
            raise FileError(f"{where}: expected {packed} bytes, got {max(stop - start, 0)}: truncated")
        sums = struct.unpack_from(f">{checks}I", head.ljust(24, b"\0"), 8)
        blocks.append(Block(start, packed, unpacked, sums[:unpacked_checks], sums[unpacked_checks:]))
        firsts.append(size)
        size += unpacked
        at = start + packed


def unpack(packed: bytes, block: Block, flags: int, where: str) -> bytes:
    """Unpack a block and compare its checksums.

    Raises
    ------
    FileError
        If they differ, or the block is damaged otherwise.
    InvalidInputError
        If the library that unpacks is not installed.
    """
    _compare(packed, block.checks_of_packed, flags, _CHECKS_OF_PACKED, where)
    if block.packed_bytes == block.unpacked_bytes:
        found = packed
    else:
        lzo = _library()
        try:
            found = lzo.LZOCompressor.decompress(packed, block.unpacked_bytes)
        except lzo.LZOError as error:
            raise FileError(f"{where}: expected packed bytes, got damaged ones: {error}") from error
    if len(found) != block.unpacked_bytes:
        raise FileError(f"{where}: expected {block.unpacked_bytes} bytes unpacked, got {len(found)}")
    _compare(found, block.checks_of_unpacked, flags, _CHECKS_OF_UNPACKED, where)
    return bytes(found)


def _compare(content: bytes, sums: tuple[int, ...], flags: int, checks: _Checks, where: str) -> None:
    methods = [method for bit, method in checks if flags & bit]
    for method, expected in zip(methods, sums, strict=False):
        found = method(content)
        if found != expected:
            raise FileError(f"{where}: expected the checksum {expected:08x}, got {found:08x}: damaged")


def _library() -> Any:
    return extra_module("lzallright", "clarius", "a file packed by lzop (.lzo)")


def _read_header(member: Member, stream: BufferedReader) -> tuple[int, int]:
    """Flags of an lzop file, and the place of its first block."""
    stream.seek(member.start)
    head = stream.read(min(member.size, 1024))
    where = f"{member.where}: header"
    if not head.startswith(MAGIC):
        raise FileError(f"{member.where}: expected a file of lzop (.lzo), got another")
    try:
        at = len(MAGIC)
        (version,) = struct.unpack_from(">H", head, at)
        newer = version >= _NEWER_HEADER
        at += 6 if newer else 4
        method = head[at]
        at += 2 if newer else 1
        (flags,) = struct.unpack_from(">I", head, at)
        at += 4 + (4 if flags & _FILTERED else 0) + (12 if newer else 8)
        at += 1 + head[at]
        (expected,) = struct.unpack_from(">I", head, at)
        found = (zlib.crc32 if flags & _HEADER_CRC32 else zlib.adler32)(head[len(MAGIC) : at])
        at += 4
        if flags & _EXTRA_FIELD:
            at += 8 + struct.unpack_from(">I", head, at)[0]
    except (struct.error, IndexError):
        raise FileError(f"{where}: expected more bytes, got {len(head)}: truncated") from None
    if found != expected:
        raise FileError(f"{where}: expected the checksum {expected:08x}, got {found:08x}: damaged")
    if method not in _LZO1X or flags & (_FILTERED | _MULTIPART):
        raise InvalidInputError(
            f"{where}: expected one file packed by LZO1X without a filter, got method {method}, flags "
            f"{flags:#x}"
        )
    return flags, member.start + at
