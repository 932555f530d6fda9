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
import zlib
from io import BufferedReader
from typing import Any, TypeAlias

import h5py
import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import PathLike, open_regular, plausible_bytes
from speckle3d.core.printable import printable

Offset: TypeAlias = tuple[int, ...]
"""Index of a chunk's first sample."""

_MOST_HOPS = 16
_MOST_LEVELS = 32
_MOST_TIMES_THE_FILE = 2
"""Beside whatever compresses well, a file of this family holds echoes, which do not."""

_DEFLATE, _SHUFFLE, _CHECKSUM, _LZF = (
    h5py.h5z.FILTER_DEFLATE,
    h5py.h5z.FILTER_SHUFFLE,
    h5py.h5z.FILTER_FLETCHER32,
    h5py.h5z.FILTER_LZF,
)
_CHECKSUM_BYTES = 4

_REFERENCE = np.dtype([("length", "<u4"), ("place", "<u8"), ("index", "<u4")])
"""To a text, in files whose addresses have eight bytes, as HDF5 writes them."""

_HEAP = b"GCOL"
"""First bytes of the places in a file that hold texts."""

_HEAP_START = _HEAP + b"\1\0\0\0"
_SEARCHED_BYTES = 2**25


def follow(group: h5py.Group, name: str) -> Any:
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
    ahead, hops = _steps(name.encode("utf-8", "surrogateescape")), 0
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
                _require_sound_heap(path, stream, start + at, size)


def _require_sound_heap(path: PathLike, stream: BufferedReader, start: int, file_bytes: int) -> None:
    where = f"{path}: heap at byte {start}"
    stream.seek(start)
    (length,) = struct.unpack("<8xQ", stream.read(16).ljust(16, b"\0"))
    if length > file_bytes - start:
        raise FileError(f"{where}: expected it in the file, got {length} bytes")
    stream.seek(start)
    heap, at = stream.read(length), 16
    while at + 16 <= length:
        index, size = struct.unpack_from("<H6xQ", heap, at)
        step = size if index == 0 else 16 + -(-size // 8) * 8
        if not 16 <= step <= length - at:
            raise FileError(f"{where}: expected entries of 16 bytes or more, got {step}")
        at += step


def require_held(node: h5py.Dataset) -> None:
    """Refuse a data set that the file itself does not hold whole.

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
        _require_chunks(node, file_bytes)
        return
    declared, stored = _bytes_of(node, node.shape), node.id.get_storage_size()
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
    _require_plausible(_bytes_of(node, node.shape), node.file.id.get_filesize())
    if node.size and node.chunks is not None and _pipeline(node):
        offsets: set[Offset] = set()
        node.id.chunk_iter(lambda chunk: offsets.add(chunk.chunk_offset))
        if len(offsets) != _chunk_count(node):
            raise InvalidInputError(f"expected {_chunk_count(node)} chunks, got {len(offsets)}")
        for offset in offsets:
            require_whole_chunk(node, offset)


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
        references = np.frombuffer(stream.read(node.size * _REFERENCE.itemsize), dtype=_REFERENCE)
        for i, (length, place, _) in enumerate(references.tolist()):
            stream.seek(min(place, file_bytes))
            if length and (length > file_bytes or stream.read(len(_HEAP)) != _HEAP):
                raise InvalidInputError(f"[{i}]: expected a text in the file, got {length} bytes at {place}")


def require_whole_chunk(node: h5py.Dataset, offset: Offset) -> None:
    """Refuse a chunk that unpacks to fewer bytes, or more, than it is to hold.

    Raises
    ------
    InvalidInputError
        Naming the chunk's first sample.
    """
    skipped, raw = node.id.read_direct_chunk(offset)
    expected = _bytes_of(node, node.chunks)
    packing = trailer = 0
    for i, filter_id in enumerate(_pipeline(node)):
        if skipped & (1 << i) or filter_id == _SHUFFLE:
            continue
        if filter_id == _CHECKSUM:
            trailer, expected = (_CHECKSUM_BYTES, expected) if packing else (0, expected + _CHECKSUM_BYTES)
        elif filter_id in (_DEFLATE, _LZF) and not packing:
            packing = filter_id
        else:
            return
    packed = raw[: len(raw) - trailer]
    if packing == _DEFLATE:
        inflate(packed, expected, offset)
    else:
        found = _lzf_length(packed) if packing == _LZF else len(packed)
        if found != expected:
            raise InvalidInputError(f"chunk {offset}: expected {expected} bytes, got {found}")


def inflate(packed: bytes, expected: int, offset: Offset) -> bytes:
    """Unpack a deflated chunk of `expected` bytes.

    Raises
    ------
    InvalidInputError
        If it unpacks to fewer bytes or more.
    zlib.error
        If it is damaged.
    """
    stream = zlib.decompressobj()
    found = stream.decompress(packed, expected + 1)
    if len(found) != expected or not stream.eof:
        got = "more" if len(found) > expected else str(len(found))
        raise InvalidInputError(f"chunk {offset}: expected {expected} bytes, got {got}")
    return found


def is_only_deflated(node: h5py.Dataset) -> bool:
    """Whether `unpacked` can make a data set's chunks: of a plain type, deflated, shuffled before or not."""
    if h5py.h5t.py_create(node.dtype) != node.id.get_type():
        return False
    if _pipeline(node) != (_SHUFFLE, _DEFLATE):
        return _pipeline(node) == (_DEFLATE,)
    shuffled_by: tuple[int, ...] = node.id.get_create_plist().get_filter(0)[2]
    return shuffled_by[:1] == (node.dtype.itemsize,)


def unpacked(node: h5py.Dataset, offset: Offset) -> npt.NDArray[Any]:
    """Read a chunk that `is_only_deflated`, as HDF5 would, but whole or not at all.

    Raises
    ------
    InvalidInputError
        If it is damaged, or unpacks to fewer bytes or more than a chunk has.
    """
    skipped, raw = node.id.read_direct_chunk(offset)
    pipeline = _pipeline(node)
    stages = {filter_id for i, filter_id in enumerate(pipeline) if not skipped & (1 << i)}
    expected = _bytes_of(node, node.chunks)
    data = inflate(raw, expected, offset) if _DEFLATE in stages else raw
    if len(data) != expected:
        raise InvalidInputError(f"chunk {offset}: expected {expected} bytes, got {len(data)}")
    values = np.frombuffer(data, dtype=np.uint8)
    if _SHUFFLE in stages:
        values = values.reshape(node.dtype.itemsize, -1).T
    flat = np.ascontiguousarray(values).reshape(-1).view(node.dtype)
    chunk: npt.NDArray[Any] = flat.reshape(node.chunks)
    return chunk.astype(node.dtype.newbyteorder("="), copy=False)


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


def _bytes_of(node: h5py.Dataset, shape: Offset) -> int:
    return math.prod(shape) * int(node.id.get_type().get_size())


def _chunk_count(node: h5py.Dataset) -> int:
    return math.prod(-(-length // chunk) for length, chunk in zip(node.shape, node.chunks, strict=True))


def _pipeline(node: h5py.Dataset) -> tuple[int, ...]:
    settings = node.id.get_create_plist()
    return tuple(settings.get_filter(i)[0] for i in range(settings.get_nfilters()))


def _require_chunks(node: h5py.Dataset, file_bytes: int) -> None:
    chunk_bytes = _bytes_of(node, node.chunks)
    _require_plausible(chunk_bytes, file_bytes)
    expected, found = _chunk_count(node), node.id.get_num_chunks()
    if found != expected:
        raise InvalidInputError(f"expected {expected} chunks of data, got {found}")
    filtered = bool(_pipeline(node))
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


def _require_plausible(size: int, file_bytes: int) -> None:
    most = plausible_bytes(file_bytes, _MOST_TIMES_THE_FILE)
    if size > most:
        raise InvalidInputError(f"expected at most {most} bytes from a file of {file_bytes}, got {size}")


def _lzf_length(packed: bytes) -> int:
    from speckle3d.kernels.packing import lzf_length

    return int(lzf_length(np.frombuffer(packed, dtype=np.uint8)))
