"""What an HDF5 file may not do: point out of itself, or claim data that it does not hold.

HDF5 follows links into other files, reads data sets whose bytes lie in other files, fills data never written
with zeros, and takes a compressed piece (a chunk) that is shorter than it claims for whole: the rest of the
frame is then whatever the memory held. A longer one is cut without a word.

Checked are the filters that HDF5 and h5py bring for every machine: deflate, lzf, shuffle and check sums. What
others (szip, plugins) make of a chunk is theirs to check.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from io import BufferedReader
from typing import Any

import h5py
import numpy as np

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import PathLike, open_regular, plausible_bytes
from speckle3d.core.printable import printable
from speckle3d.io.inflate import CHECKSUM, DEFLATE, LZF, SHUFFLE, Offset, bytes_of, inflate, pipeline

_MOST_HOPS = 16
_MOST_LEVELS = 32
_MOST_TIMES_THE_FILE = 2
"""Beside whatever compresses well, a file of this family holds echoes, which do not."""

_CHECKSUM_BYTES = 4

_REFERENCE = np.dtype([("length", "<u4"), ("place", "<u8"), ("index", "<u4")])
"""To a text, in files whose addresses have eight bytes, as HDF5 writes them."""

_HEAP = b"GCOL"
"""First bytes of the places in a file that hold texts."""

_CONTINUED, _ATTRIBUTE = 0x10, 0x0C
"""Messages in an object's header."""
_MOST_BLOCKS = 64

_HEAP_START = _HEAP + b"\1\0\0\0"
_SEARCHED_BYTES = 2**25


def follow(group: h5py.Group, name: str | bytes) -> Any:
    """Find a member of `group` by its path, never out of the file.

    Returns
    -------
    object or None
        A group, data set or type; None if there is no such name.

    Raises
    ------
    InvalidInputError
        If the name is a link to another file, or to nothing.
    """
    node: Any = group
    # h5py gives names that are no text as bytes.
    ahead, hops = _steps(name if isinstance(name, bytes) else name.encode("utf-8", "surrogateescape")), 0
    while ahead:
        step = ahead.pop()
        if not isinstance(node, h5py.Group) or not node.id.links.exists(step):
            if hops:
                raise InvalidInputError("expected a member or none of this name, got a link to nothing")
            return None
        link = node.id.links.get_info(step).type
        if link == h5py.h5l.TYPE_HARD:
            node = node[step]
        elif link == h5py.h5l.TYPE_SOFT and hops < _MOST_HOPS:
            hops += 1
            target = node.id.links.get_val(step)
            node = node.file["/"] if target.startswith(b"/") else node
            ahead += _steps(target)
        else:
            kind = "a circle of links" if link == h5py.h5l.TYPE_SOFT else "a link to another file"
            raise InvalidInputError(f"expected a member of the file itself, got {kind}")
    return node


def require_sound_heaps(path: PathLike) -> None:
    """Refuse a file whose heaps, in which HDF5 keeps texts, do not go on from each text to the next.

    On an entry of no length HDF5 runs in a circle for good. Long files are looked through at both ends, where
    attributes are.

    Raises
    ------
    FileError
        Naming the byte.
    """
    with open_regular(path) as stream:
        size = stream.seek(0, 2)
        spans = [(0, size)] if size <= 2 * _SEARCHED_BYTES else [
            (0, _SEARCHED_BYTES), (size - _SEARCHED_BYTES, size)
        ]  # fmt: skip
        for start, stop in spans:
            stream.seek(start)
            content, at = stream.read(stop - start), -1
            while (at := content.find(_HEAP_START, at + 1)) >= 0:
                _entries_of_heap(path, stream, start + at, size)


def _entries_of_heap(path: PathLike, stream: BufferedReader, start: int, file_bytes: int) -> dict[int, int]:
    """Length of each text in a heap, by its index."""
    where = f"{path}: heap at byte {start}"
    stream.seek(start)
    (length,) = struct.unpack("<8xQ", stream.read(16).ljust(16, b"\0"))
    if length > file_bytes - start:
        raise FileError(f"{where}: expected it in the file, got {length} bytes")
    stream.seek(start)
    heap, at = stream.read(length), 16
    entries: dict[int, int] = {}
    while at + 16 <= length:
        index, size = struct.unpack_from("<H6xQ", heap, at)
        step = size if index == 0 else 16 + -(-size // 8) * 8
        if not 16 <= step <= length - at:
            raise FileError(f"{where}: expected entries of 16 bytes or more, got {step}")
        if index:
            entries[index] = size
        at += step
    return entries


def require_held(node: h5py.Dataset, rows: int | None = None) -> None:
    """Refuse a data set that the file itself does not hold whole.

    Parameters
    ----------
    rows : int, optional
        Of a data set that grows: how many along its first axis are to be there; more may or may not be.

    Raises
    ------
    InvalidInputError
        If its data lie in other files, were never written, or take more room than the file has.
    """
    _require_inside(node)
    if not node.size:
        return
    file_bytes = node.file.id.get_filesize()
    if node.chunks is not None:
        _require_chunks(node, file_bytes, rows)
        return
    declared, stored = bytes_of(node, node.shape), node.id.get_storage_size()
    if stored < declared or stored > file_bytes:
        raise InvalidInputError(f"expected {declared} bytes of data, got {min(stored, file_bytes)}")


def require_own(group: h5py.Group, name: str) -> h5py.HLObject:
    """Find a member with all that is below it, and refuse it if any data of it lie in other files.

    Raises
    ------
    InvalidInputError
        Naming what lies elsewhere, or if groups lie in groups without end.
    """
    found = follow(group, name)
    ahead, seen = [(found, 0)], {_address(found)}
    while ahead:
        node, depth = ahead.pop()
        if isinstance(node, h5py.Dataset):
            _require_inside(node)
        if not isinstance(node, h5py.Group):
            continue
        if depth == _MOST_LEVELS:
            raise InvalidInputError(f"{name}: expected at most {_MOST_LEVELS} groups in each other, got more")
        for step in node.id:
            below = follow(node, step.decode("utf-8", "surrogateescape"))
            if _address(below) not in seen:
                seen.add(_address(below))
                ahead.append((below, depth + 1))
    return found


def require_readable(node: h5py.Dataset) -> None:
    """Refuse a data set, held by the file, that is not to be read in one piece.

    Raises
    ------
    InvalidInputError
        If it would take far more memory than the file is long, or a chunk is shorter or longer than it says.
    """
    _require_plausible(bytes_of(node, node.shape), node.file.id.get_filesize())
    if node.size and node.chunks is not None and pipeline(node):
        offsets: set[Offset] = set()
        node.id.chunk_iter(lambda chunk: offsets.add(chunk.chunk_offset))
        if len(offsets) != _chunk_count(node):
            raise InvalidInputError(f"expected {_chunk_count(node)} chunks, got {len(offsets)}")
        for offset in offsets:
            require_whole_chunk(node, offset)


def require_plausible_rows(node: h5py.Dataset) -> None:
    """Refuse a data set that grows, is not compressed and says that it is far longer than the file.

    Raises
    ------
    InvalidInputError
        Also if it is compressed.
    """
    if pipeline(node):
        raise InvalidInputError("expected numbers that are not compressed, in a file that grows")
    _require_plausible(bytes_of(node, node.shape), node.file.id.get_filesize())


def require_texts(node: h5py.Dataset) -> None:
    """Refuse texts of free length whose places in the file are not places of texts.

    HDF5 makes room for as many bytes as a reference claims, up to 4 GB each, before it looks at the place.

    Raises
    ------
    InvalidInputError
        Naming the first that is wrong, or if they are stored otherwise than in one run.
    """
    if not node.size or not node.id.get_type().is_variable_str():
        return
    at, file_bytes = node.id.get_offset(), node.file.id.get_filesize()
    if node.id.get_create_plist().get_layout() != h5py.h5d.CONTIGUOUS or at is None:
        raise InvalidInputError("expected texts stored in one run, got chunks")
    with open_regular(node.file.filename) as stream:
        stream.seek(at)
        _require_in_heaps(
            stream, stream.read(node.size * _REFERENCE.itemsize), file_bytes, node.file.filename
        )


def _require_in_heaps(stream: BufferedReader, references: bytes, file_bytes: int, path: str) -> None:
    """Refuse references to texts that are not where they say, or not so long."""
    heaps: dict[int, dict[int, int]] = {}
    for i, (length, place, index) in enumerate(np.frombuffer(references, dtype=_REFERENCE).tolist()):
        if not length:
            continue
        if place not in heaps:
            stream.seek(min(place, file_bytes))
            is_heap = stream.read(len(_HEAP)) == _HEAP
            heaps[place] = _entries_of_heap(path, stream, place, file_bytes) if is_heap else {}
        if length > heaps[place].get(index, 0):
            raise InvalidInputError(f"[{i}]: expected a text in the file, got {length} bytes at {place}")


def require_whole_chunk(node: h5py.Dataset, offset: Offset) -> None:
    """Refuse a chunk that unpacks to fewer bytes, or more, than it is to hold.

    Raises
    ------
    InvalidInputError
        Naming the chunk's first sample.
    """
    skipped, raw = node.id.read_direct_chunk(offset)
    expected = bytes_of(node, node.chunks)
    packing = trailer = 0
    for i, filter_id in enumerate(pipeline(node)):
        if skipped & (1 << i) or filter_id == SHUFFLE:
            continue
        if filter_id == CHECKSUM:
            trailer, expected = (_CHECKSUM_BYTES, expected) if packing else (0, expected + _CHECKSUM_BYTES)
        elif filter_id in (DEFLATE, LZF) and not packing:
            packing = filter_id
        else:
            return
    packed = raw[: len(raw) - trailer]
    if packing == DEFLATE:
        inflate(packed, expected, offset)
    else:
        found = _lzf_length(packed) if packing == LZF else len(packed)
        if found != expected:
            raise InvalidInputError(f"chunk {offset}: expected {expected} bytes, got {found}")


def is_filtered(node: h5py.Dataset) -> bool:
    """Whether filters made a data set's chunks, whose length then says nothing."""
    return bool(pipeline(node))


def _steps(path: bytes) -> list[bytes]:
    """Names along a path, the last first."""
    return [step for step in reversed(path.split(b"/")) if step not in (b"", b".")]


def _address(node: h5py.HLObject) -> int:
    return int(h5py.h5o.get_info(node.id).addr)


def _require_inside(node: h5py.Dataset) -> None:
    settings = node.id.get_create_plist()
    if node.is_virtual:
        raise InvalidInputError("expected its data in the file, got a virtual data set (of other files)")
    if settings.get_external_count():
        raise InvalidInputError(f"expected its data in the file, got them in {_external_names(settings)}")


def _external_names(settings: Any) -> str:
    name, _, _ = settings.get_external(0)
    return printable(repr(name.decode("utf-8", "replace")))


def _chunk_count(node: h5py.Dataset, rows: int | None = None) -> int:
    shape = node.shape if rows is None else (rows, *node.shape[1:])
    return math.prod(-(-length // chunk) for length, chunk in zip(shape, node.chunks, strict=True))


def _require_chunks(node: h5py.Dataset, file_bytes: int, rows: int | None) -> None:
    chunk_bytes = bytes_of(node, node.chunks)
    _require_plausible(chunk_bytes, file_bytes)
    if rows is None:
        expected, found = _chunk_count(node), node.id.get_num_chunks()
    else:
        within: list[Offset] = []
        node.id.chunk_iter(lambda chunk: _append_if(within, chunk.chunk_offset, rows))
        expected, found = _chunk_count(node, rows), len(within)
    if found != expected:
        raise InvalidInputError(f"expected {expected} chunks of data, got {found}")
    filtered = bool(pipeline(node))
    wrong: list[tuple[Offset, int]] = []

    def check(chunk: Any) -> bool | None:
        if chunk.size > file_bytes or not (filtered or chunk.size == chunk_bytes):
            wrong.append((chunk.chunk_offset, chunk.size))
            return True
        return None

    node.id.chunk_iter(check)
    if wrong:
        offset, size = wrong[0]
        raise InvalidInputError(f"chunk {offset}: expected {chunk_bytes} bytes, got {size}")


def _append_if(kept: list[Offset], offset: Offset, rows: int) -> None:
    if offset[0] < rows:
        kept.append(offset)


def _require_plausible(size: int, file_bytes: int) -> None:
    most = plausible_bytes(file_bytes, _MOST_TIMES_THE_FILE)
    if size > most:
        raise InvalidInputError(f"expected at most {most} bytes from a file of {file_bytes}, got {size}")


def _lzf_length(packed: bytes) -> int:
    from speckle3d.kernels.packing import lzf_length

    return int(lzf_length(np.frombuffer(packed, dtype=np.uint8)))


def plain_attribute(node: h5py.Group | h5py.Dataset, name: str) -> Any:
    """Value of an attribute of numbers or text; None if there is none.

    Raises
    ------
    InvalidInputError
        If it is of another kind, among which are some that HDF5 does not survive where a file is damaged.
    """
    if name not in node.attrs:
        return None
    attribute = node.attrs.get_id(name)
    kind = attribute.get_type()
    if kind.get_class() not in (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.STRING, h5py.h5t.ENUM):
        raise InvalidInputError(f"expected a number or a text, got HDF5's type {kind.get_class()}")
    if isinstance(kind, h5py.h5t.TypeStringID) and kind.is_variable_str():
        size = attribute.get_space().get_simple_extent_npoints() * _REFERENCE.itemsize
        with open_regular(node.file.filename) as stream:
            file_bytes = node.file.id.get_filesize()
            for value in _attribute_values(stream, h5py.h5o.get_info(node.id).addr, name, file_bytes):
                _require_in_heaps(stream, value[:size], file_bytes, node.file.filename)
    return node.attrs[name]


def _attribute_values(stream: BufferedReader, address: int, name: str, file_bytes: int) -> Iterator[bytes]:
    """Bytes of an attribute in an object's header of version 1, which h5py writes; none of another version.

    References
    ----------
    .. [1] HDF5 File Format Specification 3.0, IV.A.1.a and IV.A.2.m.
    """
    stream.seek(address)
    version, size = struct.unpack("<B7xI", stream.read(12).ljust(12, b"\0"))
    blocks = [(address + 16, size)] if version == 1 else []
    for at, length in blocks:
        stream.seek(min(at, file_bytes))
        content, start = stream.read(min(length, file_bytes)), 0
        while start + 8 <= len(content):
            kind, size = struct.unpack_from("<HH", content, start)
            message = content[start + 8 : start + 8 + size]
            start += 8 + size
            if kind == _CONTINUED and len(message) >= 16 and len(blocks) < _MOST_BLOCKS:
                blocks.append(struct.unpack_from("<QQ", message))
            elif kind == _ATTRIBUTE and len(message) >= 8:
                named, value = _parted(message)
                if named == name.encode("utf-8", "surrogateescape"):
                    yield value


def _parted(message: bytes) -> tuple[bytes, bytes]:
    """Name and value of an attribute's message."""
    version, *sizes = struct.unpack_from("<BxHHH", message)
    padded = [-(-size // 8) * 8 if version == 1 else size for size in sizes]
    start = 9 if version == 3 else 8
    name = message[start : start + sizes[0]].split(b"\0")[0]
    return name, message[start + sum(padded) :]
