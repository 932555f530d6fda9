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

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import open_regular
from speckle3d.io.frames import FileFrames, ReadFrame
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording, Row, Value

FORMAT = "Ultrasonix"

_HEADER = struct.Struct("<19i")
_NAMES = (
    "kind", "frames", "width", "height", "bits", *map(str, range(8)), "probe", "transmit_hz", "sampling_hz",
    "rate_hz", "lines", "extra",
)  # fmt: skip
_TAG_BYTES = 4
_MOST_FRAMES, _MOST_LENGTH = 10**6, 2**16
_READ = {2: ("B-mode before scan conversion (.bpr)", 8), 4: ("B-mode (.b8)", 8), 16: ("RF (.rf)", 16)}
"""Name and bits of the types that are read; all are powers of two."""
_BMODE, _LAST_TYPE = 4, 2**19
_SUFFIXES = (".rf", ".bpr", ".b8", ".b32", ".mpr", ".drf", ".pw", ".crf", ".col", ".cvv", ".el", ".gps")


@dataclass(frozen=True)
class _File:
    """Opens frames that lie one after the other.

    Attributes
    ----------
    step_bytes : int
        From frame to frame; a frame's pixels are the last of them.
    """

    path: Path
    dtype: str
    shape: tuple[int, int]
    step_bytes: int
    is_image: bool

    def __call__(self) -> ReadFrame:
        """Open nothing: the file is open only while a frame is read."""
        return self.read

    def read(self, i: int) -> npt.NDArray[Any]:
        """Read frame i, shape (vector, sample)."""
        width, height = self.shape
        count = width * height
        start = _HEADER.size + (i + 1) * self.step_bytes - count * np.dtype(self.dtype).itemsize
        values = np.fromfile(self.path, self.dtype, count, offset=start)
        return values.reshape(height, width).T if self.is_image else values.reshape(width, height)


def _header(content: bytes) -> dict[str, int]:
    return dict(zip(_NAMES, _HEADER.unpack_from(content), strict=True))


def _step_bytes(header: dict[str, int], size: int) -> int | None:
    """Bytes from frame to frame, with the frames' numbers or not, by the file's size; None if neither."""
    pixels = header["width"] * header["height"] * header["bits"] // 8
    steps = (pixels + _TAG_BYTES, pixels)
    return next((step for step in steps if size == _HEADER.size + header["frames"] * step), None)


def _claims(path: Path, start: bytes) -> bool:
    if len(start) < _HEADER.size:
        return False
    header = _header(start)
    sides = all(0 < header[name] <= _MOST_LENGTH for name in ("width", "height"))
    is_type = 0 < header["kind"] <= _LAST_TYPE and header["kind"].bit_count() == 1
    is_sound = (
        is_type and sides and 0 <= header["frames"] <= _MOST_FRAMES and header["bits"] in (8, 16, 24, 32)
    )
    is_named = path.suffix.lower() in _SUFFIXES
    return is_sound and (is_named or _step_bytes(header, path.stat().st_size) is not None)


def open_ultrasonix(path: Path, settings: ImportSettings) -> Recording:
    """Read RF or B-mode of a linear probe.

    The header has no line pitch and no band; of B-mode no pixel size and no dynamic range.
    """
    with open_regular(path) as stream:
        header = _header(stream.read(_HEADER.size))
        size = stream.seek(0, 2)
    name, bits = _READ.get(header["kind"], (f"type {header['kind']}", 0))
    rows: list[Row] = [
        ("recorded", name, ""),
        ("probe's number", str(header["probe"]), ""),
        ("line density", str(header["lines"]), "lines"),
    ]
    values = {
        "sampling_rate_hz": Value(float(header["sampling_hz"]) or None, "in the header"),
        "centre_frequency_hz": Value(float(header["transmit_hz"]) or None, "in the header: transmitted"),
        "frame_rate_hz": Value(max(header["rate_hz"], 0) or None, "in the header"),
    }

    def recording() -> Recording:
        count, step = header["frames"], _step_bytes(header, size)
        if header["bits"] != bits or not count:
            raise InvalidInputError(
                f"{path}: expected frames of RF, of 16 bits, or B-mode, of 8, got {count} of {name}, of "
                f"{header['bits']} bits"
            )
        if step is None:
            whole = 8 * (size - _HEADER.size) // (header["width"] * header["height"] * bits)
            raise FileError(f"{path}: ends early, or is longer than its frames: {whole} of {count} frames")
        is_image, shape = header["kind"] == _BMODE, (header["width"], header["height"])
        source = _File(path, "<i2" if bits == 16 else "u1", shape, step, is_image)
        frames = FileFrames(path, source, (count, *shape), np.int16 if bits == 16 else np.uint8)
        return Recording(path, settings, frames, values, assumptions=() if is_image else ("parallel lines",))

    return Recording.of(path, settings, rows, recording)


READER = Reader(FORMAT, _claims, open_ultrasonix)
