"""Recordings of Ultrasonix (Sonix): RF ``.rf``, B-mode ``.bpr`` before and ``.b8`` after scan conversion.

A file begins with 19 integers of four bytes (the ``uFileHeader`` of the maker's research interface and of
its MATLAB reader ``RPread``): type, frames, width, height, bits of a sample, x and y of the four corners,
probe, transmit frequency in Hz, sampling frequency in Hz, data rate in frames/s, line density, and one more.
Then come the frames. Software before 6.0 put the frame's number, four bytes, before each: the file's length
tells.

Of RF and ``.bpr``, width counts vectors and height samples, and a vector's samples lie together; of ``.b8``,
they are the image's columns and rows, and a row lies together.
"""

import struct
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

_HEADER = struct.Struct("<19i")
_READ = {2: ("B-mode before scan conversion (.bpr)", 8), 4: ("B-mode (.b8)", 8), 16: ("RF (.rf)", 16)}
"""Name and bits of the types that are read; all are powers of two."""
_BMODE = 4
_SUFFIXES = (".rf", ".bpr", ".b8", ".crf", ".col")


def _open_frames(path: Path, record: np.dtype[Any], count: int, is_image: bool) -> ReadFrame:
    """Map frames that lie one after the other, each with its number before it or not."""
    pixels = np.memmap(path, record, "r", _HEADER.size, (count,))["pixels"]
    return lambda i: pixels[i].T if is_image else pixels[i]


def _tag_bytes(size: int, frames: int, width: int, height: int, bits: int) -> int | None:
    """Bytes of the number before each frame, by the file's size: 4 or none; None if it is neither's."""
    sizes = {_HEADER.size + frames * (width * height * bits // 8 + tag): tag for tag in (0, 4)}
    return sizes.get(size) if frames > 0 else None


def _claims(path: Path, start: bytes) -> bool:
    if len(start) < _HEADER.size:
        return False
    kind, *sizes = _HEADER.unpack_from(start)[:5]
    is_whole = _tag_bytes(path.stat().st_size, *sizes) is not None
    return kind.bit_count() == 1 and (is_whole or path.suffix.lower() in _SUFFIXES)


def open_ultrasonix(path: Path, settings: ImportSettings) -> Facts:
    """Read RF or B-mode of a linear probe.

    The header has no line pitch and no band; of B-mode no pixel size and no dynamic range.
    """
    header = _HEADER.unpack_from(first_bytes(path))
    kind, count, width, height, bits = header[:5]
    probe, transmit_hz, sampling_hz, rate_hz, lines, _ = header[13:]
    name, expected_bits = _READ.get(kind, (f"type {kind}", 0))
    yield "recorded", name, ""
    yield "probe's number", str(probe), ""
    yield "line density", str(lines), "lines"
    values = {
        "sampling_rate_hz": Value(sampling_hz or None, "in the header"),
        "centre_frequency_hz": Value(transmit_hz or None, "in the header: transmitted"),
        "frame_rate_hz": Value(rate_hz or None, "in the header"),
    }
    if bits != expected_bits or min(count, width, height) < 1:
        raise InvalidInputError(
            f"expected frames of RF, of 16 bits, or B-mode, of 8, got {count} of {name}, {width} x {height} "
            f"of {bits} bits"
        )
    size = path.stat().st_size
    if (tag := _tag_bytes(size, count, width, height, bits)) is None:
        whole = 8 * (size - _HEADER.size) // (width * height * bits)
        raise FileError(f"{path}: ends early, or is longer than its frames: {whole} of {count} frames")
    is_image, dtype = kind == _BMODE, np.dtype("<i2" if bits == 16 else "u1")
    shape = (height, width) if is_image else (width, height)
    record = np.dtype([("tag", f"V{tag}"), ("pixels", dtype, shape)])
    source = partial(_open_frames, path, record, count, is_image)
    frames = FileFrames(path, source, (count, width, height), dtype.newbyteorder("="))
    return Recording(path, settings, frames, values, assumptions=() if is_image else ("parallel lines",))


READER = Reader(FORMAT, _claims, open_ultrasonix)
