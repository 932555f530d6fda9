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
from speckle3d.core.sweep import Sweep
from speckle3d.io.formats.recordings import Recording
from speckle3d.io.found import Found
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.lazy import Layout, RawFrames, Real
from speckle3d.io.readers import Reader, Row

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
    corners: tuple[int, ...]
    probe: int
    transmit_hz: int
    sampling_hz: int
    frame_rate_hz: int
    line_density: int

    @property
    def frame_bytes(self) -> int:
        return self.width * self.height * self.bits // 8

    def is_sound(self) -> bool:
        return (
            self.kind in _TYPES
            and 0 <= self.frames <= _MOST_FRAMES
            and 0 < self.width <= _MOST_LENGTH
            and 0 < self.height <= _MOST_LENGTH
            and self.bits in (8, 16, 24, 32)
        )

    def tag_bytes(self, size: int) -> int | None:
        """Bytes before each frame, by the file's size; None if it fits neither."""
        for tag in (0, _TAG_BYTES):
            if size == _HEADER.size + self.frames * (tag + self.frame_bytes):
                return tag
        return None


def read_ultrasonix(path: Path, settings: ImportSettings | None = None) -> Sweep:
    """Read RF or B-mode of a linear probe; frames stay on disk until they are asked for.

    The header has no line pitch and no band; of B-mode no pixel size and no dynamic range.

    Raises
    ------
    FileError
        If the file cannot be read or is not as long as its header says.
    InvalidInputError
        Naming what is recorded, if it is neither.
    MissingSettingsError
        Naming all that the header does not say.
    """
    return _recording(path).sweep(settings or ImportSettings())


def _claims(path: Path, start: bytes) -> bool:
    if len(start) < _HEADER.size:
        return False
    header = _unpacked(start)
    return header.is_sound() and (
        path.suffix.lower() in _SUFFIXES or header.tag_bytes(path.stat().st_size) is not None
    )


def _describe(path: Path, settings: ImportSettings) -> list[Row]:
    try:
        return _recording(path).rows(settings)
    except InvalidInputError:
        # Why there is no sweep is told beside these rows.
        return _notes(_header(path)[0])


def _notes(header: _Header) -> list[Row]:
    return [
        ("recorded", _TYPES[header.kind], ""),
        ("probe's number", str(header.probe), ""),
        ("line density", str(header.line_density), "lines"),
        ("lines", "taken for parallel, as of a linear probe: the file does not say", ""),
    ]


def _recording(path: Path) -> Recording:
    header, size = _header(path)
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
        longer = expected + header.frames * _TAG_BYTES
        raise FileError(f"{path}: expected {expected} bytes, or {longer} with frame numbers, got {size}")
    scan_converted = header.kind == 4
    shape = (header.height, header.width) if scan_converted else (header.width, header.height)
    layout = Layout(shape, (1, 0) if scan_converted else (0, 1))
    dtype = np.dtype("<i2" if header.kind == 16 else "u1")
    return Recording(
        path,
        RawFrames(
            path,
            _HEADER.size + tag,
            tag + header.frame_bytes,
            dtype,
            Real(layout),
            (header.frames, header.width, header.height),
            dtype.newbyteorder("="),
        ),
        {
            "sampling_rate_hz": Found(float(header.sampling_hz) or None, "in the header"),
            "centre_frequency_hz": Found(float(header.transmit_hz) or None, "in the header: transmitted"),
            "frame_rate_hz": Found(
                header.frame_rate_hz if header.frame_rate_hz > 0 else None, "in the header"
            ),
        },
        notes=tuple(_notes(header)),
    )


def _header(path: Path) -> tuple[_Header, int]:
    with open_regular(path) as stream:
        content = stream.read(_HEADER.size)
        size = stream.seek(0, 2)
    if len(content) < _HEADER.size:
        raise FileError(f"{path}: expected a header of {_HEADER.size} bytes, got {len(content)}")
    header = _unpacked(content)
    if not header.is_sound():
        raise InvalidInputError(
            f"{path}: expected a header of Ultrasonix, got type {header.kind}, {header.frames} frames of "
            f"{header.width} x {header.height}, {header.bits} bits"
        )
    return header, size


def _unpacked(content: bytes) -> _Header:
    kind, frames, width, height, bits, *rest = _HEADER.unpack_from(content)
    probe, transmit_hz, sampling_hz, rate, density, _ = rest[8:]
    return _Header(
        kind, frames, width, height, bits, tuple(rest[:8]), probe, transmit_hz, sampling_hz, rate, density
    )


def _contradictions(path: Path, settings: ImportSettings) -> list[str]:
    return _recording(path).contradictions(settings)


READER = Reader(FORMAT, _claims, read_ultrasonix, _describe, notes=_contradictions)
