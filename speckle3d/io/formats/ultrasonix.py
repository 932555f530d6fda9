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
_TAG_BYTES = 4
_MOST_FRAMES, _MOST_LENGTH = 10**6, 2**16
_BMODE, _RF, _LAST_TYPE = 4, 16, 2**19
_READ = {2: ("B-mode before scan conversion (.bpr)", 8), 4: ("B-mode (.b8)", 8), 16: ("RF (.rf)", 16)}
"""Name and bits of the types that are read; all are powers of two."""
_SUFFIXES = (".rf", ".bpr", ".b8", ".b32", ".mpr", ".drf", ".pw", ".crf", ".col", ".cvv", ".el", ".gps")


@dataclass(frozen=True)
class _Header:
    kind: int
    frames: int
    width: int
    height: int
    bits: int
    probe: int
    transmit_hz: int
    sampling_hz: int
    frame_rate_hz: int
    line_density: int

    @classmethod
    def unpacked(cls, content: bytes) -> _Header:
        values = _HEADER.unpack_from(content)
        return cls(*values[:5], *values[13:18])

    @property
    def frame_bytes(self) -> int:
        return self.width * self.height * self.bits // 8

    def is_sound(self) -> bool:
        sides = 0 < self.width <= _MOST_LENGTH and 0 < self.height <= _MOST_LENGTH
        is_type = 0 < self.kind <= _LAST_TYPE and self.kind.bit_count() == 1
        return is_type and 0 <= self.frames <= _MOST_FRAMES and sides and self.bits in (8, 16, 24, 32)

    def step_bytes(self, size: int) -> int | None:
        """Bytes from frame to frame, with the frames' numbers or not, by the file's size; None if neither."""
        steps = (self.frame_bytes + _TAG_BYTES, self.frame_bytes)
        return next((step for step in steps if size == _HEADER.size + self.frames * step), None)


@dataclass(frozen=True)
class _File:
    """Opens frames that lie one after the other."""

    path: Path
    header: _Header
    step_bytes: int

    def __call__(self) -> ReadFrame:
        """Open nothing: the file is open only while a frame is read."""
        return self.read

    def read(self, i: int) -> npt.NDArray[Any]:
        """Read frame i, the last bytes of its step."""
        header, dtype = self.header, "<i2" if self.header.kind == _RF else "u1"
        offset = _HEADER.size + (i + 1) * self.step_bytes - header.frame_bytes
        values = np.fromfile(self.path, dtype, header.width * header.height, offset=offset)
        is_image = header.kind == _BMODE
        return values.reshape(header.height, -1).T if is_image else values.reshape(header.width, -1)


def _claims(path: Path, start: bytes) -> bool:
    if len(start) < _HEADER.size:
        return False
    header = _Header.unpacked(start)
    is_named = path.suffix.lower() in _SUFFIXES
    return header.is_sound() and (is_named or header.step_bytes(path.stat().st_size) is not None)


def open_ultrasonix(path: Path, settings: ImportSettings) -> Recording:
    """Read RF or B-mode of a linear probe.

    The header has no line pitch and no band; of B-mode no pixel size and no dynamic range.
    """
    with open_regular(path) as stream:
        header = _Header.unpacked(stream.read(_HEADER.size))
        size = stream.seek(0, 2)
    name, bits = _READ.get(header.kind, (f"type {header.kind}", 0))
    rows: list[Row] = [
        ("recorded", name, ""),
        ("probe's number", str(header.probe), ""),
        ("line density", str(header.line_density), "lines"),
    ]
    values = {
        "sampling_rate_hz": Value(float(header.sampling_hz) or None, "in the header"),
        "centre_frequency_hz": Value(float(header.transmit_hz) or None, "in the header: transmitted"),
        "frame_rate_hz": Value(max(header.frame_rate_hz, 0) or None, "in the header"),
    }
    lines = () if header.kind == _BMODE else ("parallel lines",)

    def recording() -> Recording:
        if header.bits != bits or not header.frames:
            raise InvalidInputError(
                f"{path}: expected frames of RF, of 16 bits, or B-mode, of 8, got {header.frames} of {name}, "
                f"of {header.bits} bits"
            )
        if (step := header.step_bytes(size)) is None:
            whole = min((size - _HEADER.size) // header.frame_bytes, header.frames)
            got = f"{whole} of {header.frames} frames" if whole < header.frames else f"{size} bytes"
            raise FileError(f"{path}: ends early, or is longer than its frames: {got}")
        dtype = np.int16 if header.kind == _RF else np.uint8
        shape = header.frames, header.width, header.height
        frames = FileFrames(path, _File(path, header, step), shape, dtype)
        return Recording(path, settings, frames, values, assumptions=lines)

    return Recording.of(path, settings, rows, recording)


READER = Reader(FORMAT, _claims, open_ultrasonix)
