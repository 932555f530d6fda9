"""Recordings of Ultrasonix (Sonix): RF ``.rf``, B-mode ``.bpr`` before and ``.b8`` after scan conversion.

A file begins with 19 integers of four bytes (the ``uFileHeader`` of the maker's research interface and of
its MATLAB reader ``RPread``): type, frames, width, height, bits of a sample, x and y of the four corners,
probe, transmit frequency in Hz, sampling frequency in Hz, data rate in frames/s, line density, and one more.
Then come the frames. Software before 6.0 put the frame's number, four bytes, before each: the file's length
tells.

Of RF and ``.bpr``, width counts vectors and height samples, and a vector's samples lie together; of ``.b8``,
they are the image's columns and rows, and a row lies together.
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.io.frames import FileFrames, ReadFrame
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.readers import Reader, first_bytes
from speckle3d.io.recordings import Facts, Recording, Value

FORMAT = "Ultrasonix"

_NAMES = (
    "kind", "frames", "width", "height", "bits", *map(str, range(8)), "probe", "transmit_hz", "sampling_hz",
    "rate_hz", "lines", "extra",
)  # fmt: skip
_HEADER = np.dtype([(name, "<i4") for name in _NAMES])
_READ = {2: ("B-mode before scan conversion (.bpr)", 8), 4: ("B-mode (.b8)", 8), 16: ("RF (.rf)", 16)}
"""Name and bits of the types that are read; all are powers of two."""
_BMODE, _LAST_TYPE = 4, 2**19
_SUFFIXES = (".rf", ".bpr", ".b8", ".crf", ".col")


def _open_frames(path: Path, record: np.dtype[Any], count: int, is_image: bool) -> ReadFrame:
    """Map frames that lie one after the other, each with its number before it or not."""
    pixels = np.memmap(path, record, "r", _HEADER.itemsize, (count,))["pixels"]
    return lambda i: pixels[i].T if is_image else pixels[i]


def _header(content: bytes) -> Any:
    return np.frombuffer(content, _HEADER, 1)[0]


def _has_tags(header: Any, size: int) -> bool | None:
    """Whether each frame has its number before it, by the file's size; None if that is neither's."""
    frames, *sides = (int(header[name]) for name in ("frames", "width", "height", "bits"))
    sizes = {_HEADER.itemsize + frames * (math.prod(sides) // 8 + tag): bool(tag) for tag in (0, 4)}
    return sizes.get(size) if frames > 0 < min(sides) else None


def _claims(path: Path, start: bytes) -> bool:
    if len(start) < _HEADER.itemsize or not 0 < (kind := int(_header(start)["kind"])) <= _LAST_TYPE:
        return False
    is_whole = _has_tags(_header(start), path.stat().st_size) is not None
    return kind.bit_count() == 1 and (is_whole or path.suffix.lower() in _SUFFIXES)


def open_ultrasonix(path: Path, settings: ImportSettings) -> Facts:
    """Read RF or B-mode of a linear probe.

    The header has no line pitch and no band; of B-mode no pixel size and no dynamic range.
    """
    header, size = _header(first_bytes(path)), path.stat().st_size
    name, bits = _READ.get(int(header["kind"]), (f"type {header['kind']}", 0))
    yield "recorded", name, ""
    yield "probe's number", str(header["probe"]), ""
    yield "line density", str(header["lines"]), "lines"
    values = {
        "sampling_rate_hz": Value(float(header["sampling_hz"]) or None, "in the header"),
        "centre_frequency_hz": Value(float(header["transmit_hz"]) or None, "in the header: transmitted"),
        "frame_rate_hz": Value(max(int(header["rate_hz"]), 0) or None, "in the header"),
    }
    count, width, height = (int(header[name]) for name in ("frames", "width", "height"))
    if header["bits"] != bits or not count:
        raise InvalidInputError(
            f"expected frames of RF, of 16 bits, or B-mode, of 8, got {count} of {name}, of "
            f"{header['bits']} bits"
        )
    if (has_tags := _has_tags(header, size)) is None:
        whole = 8 * (size - _HEADER.itemsize) // (width * height * bits)
        raise FileError(f"{path}: ends early, or is longer than its frames: {whole} of {count} frames")
    is_image, dtype = header["kind"] == _BMODE, np.dtype("<i2" if bits == 16 else "u1")
    shape = (height, width) if is_image else (width, height)
    tag = [("tag", "<i4")] if has_tags else []
    source = partial(_open_frames, path, np.dtype([*tag, ("pixels", dtype, shape)]), count, is_image)
    frames = FileFrames(path, source, (count, width, height), dtype.newbyteorder("="))
    return Recording(path, settings, frames, values, assumptions=() if is_image else ("parallel lines",))


READER = Reader(FORMAT, _claims, open_ultrasonix)
