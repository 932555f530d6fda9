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

import numpy as np

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import open_regular
from speckle3d.io.frames import FileFrames, RawFile
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording, Row, Value

FORMAT = "Ultrasonix"

_HEADER = struct.Struct("<19i")
_TAG_BYTES = 4
_MOST_FRAMES, _MOST_LENGTH = 10**6, 2**16

_TYPES = {
    1: "screen", 2: "B-mode before scan conversion (.bpr)", 4: "B-mode (.b8)", 8: "B-mode of 32 bits (.b32)",
    16: "RF (.rf)", 32: "M-mode (.mpr)", 64: "M-mode (.m)", 128: "pulsed Doppler RF (.drf)",
    256: "pulsed Doppler spectrum (.pw)", 512: "colour Doppler RF (.crf)", 1024: "colour Doppler (.col)",
    2048: "colour velocity and variance (.cvv)", 4096: "elastography (.el)", 8192: "elastography",
    16384: "elastography", 32768: "elastography", 65536: "ECG", 131072: "position sensor (.gps)",
    262144: "position sensor (.gps)", 524288: "position sensor",
}  # fmt: skip
_BITS = {2: 8, 4: 8, 16: 16}
"""Of the types that are read."""
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
        return (
            self.kind in _TYPES
            and 0 <= self.frames <= _MOST_FRAMES
            and sides
            and self.bits in (8, 16, 24, 32)
        )

    def tag_bytes(self, size: int) -> int | None:
        """Bytes before each frame, by the file's size; None if it fits neither."""
        sizes = {_HEADER.size + self.frames * (tag + self.frame_bytes): tag for tag in (_TAG_BYTES, 0)}
        return sizes.get(size)


def _claims(path: Path, start: bytes) -> bool:
    if len(start) < _HEADER.size:
        return False
    header = _Header.unpacked(start)
    named = path.suffix.lower() in _SUFFIXES
    return header.is_sound() and (named or header.tag_bytes(path.stat().st_size) is not None)


def open_ultrasonix(path: Path, settings: ImportSettings) -> Recording:
    """Read RF or B-mode of a linear probe.

    The header has no line pitch and no band; of B-mode no pixel size and no dynamic range.
    """
    with open_regular(path) as stream:
        header = _Header.unpacked(stream.read(_HEADER.size))
        size = stream.seek(0, 2)
    rows: tuple[Row, ...] = (
        ("recorded", _TYPES[header.kind], ""),
        ("probe's number", str(header.probe), ""),
        ("line density", str(header.line_density), "lines"),
    )
    try:
        frames = _frames(path, header, size)
    except (InvalidInputError, FileError) as error:
        return Recording(path, settings, rows=rows, fault=error)
    values = {
        "sampling_rate_hz": Value(float(header.sampling_hz) or None, "in the header"),
        "centre_frequency_hz": Value(float(header.transmit_hz) or None, "in the header: transmitted"),
        "frame_rate_hz": Value(max(header.frame_rate_hz, 0) or None, "in the header"),
    }
    lines = () if header.kind == 4 else ("parallel lines",)
    return Recording(path, settings, frames, values, assumptions=lines, rows=rows)


def _frames(path: Path, header: _Header, size: int) -> FileFrames:
    if header.kind not in _BITS:
        raise InvalidInputError(f"{path}: expected RF or B-mode of 8 bits, got {_TYPES[header.kind]}")
    if header.bits != _BITS[header.kind]:
        raise InvalidInputError(
            f"{path}: expected samples of {_BITS[header.kind]} bits, got {header.bits} bits"
        )
    if not header.frames:
        raise InvalidInputError(f"{path}: expected frames, got none")
    tag = header.tag_bytes(size)
    if tag is None:
        expected = _HEADER.size + header.frames * header.frame_bytes
        if size < expected:
            whole = (size - _HEADER.size) // header.frame_bytes
            raise FileError(f"{path}: ends early: {whole} of {header.frames} frames")
        longer = expected + header.frames * _TAG_BYTES
        raise FileError(f"{path}: expected {expected} bytes, or {longer} with frame numbers, got {size}")
    is_image = header.kind == 4
    shape = (header.height, header.width) if is_image else (header.width, header.height)
    dtype = np.dtype("<i2" if header.kind == 16 else "u1")
    turn = np.transpose if is_image else np.asarray
    source = RawFile(path, _HEADER.size + tag, tag + header.frame_bytes, dtype, shape, turn)
    return FileFrames(path, source, (header.frames, header.width, header.height), dtype.newbyteorder("="))


READER = Reader(FORMAT, _claims, open_ultrasonix)
