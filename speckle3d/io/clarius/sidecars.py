"""Descriptions of raw files (yml) and their gain by frame (tgc).

The yml is YAML but for its gain curve, ``tgc: { 0.00mm, 23.00dB }{ 40.00mm, 26.00dB }``, which is read apart.
Every number is read with its unit.

References
----------
.. [1] clariusdev/research, "Raw Data Format" (docs/raw-data-format.md), ".yml metadata".
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.io.clarius.documents import documents_of, quantity, shown
from speckle3d.io.clarius.package import Member

Curve = tuple[tuple[float, float], ...]
"""Depth in mm and gain in dB of each knot of a gain curve."""

_KINDS = {"rf": "RF", "iq": "IQ", "b pre-scan": "envelope", "envelope": "envelope", "b": "envelope"}
_KNOT = re.compile(r"\{\s*([-+.\deE]+)\s*mm\s*,\s*([-+.\deE]+)\s*dB\s*\}")
_GAIN_LINE = re.compile(r"^tgc:.*(?:\n[ \t]+-.*)*$", re.MULTILINE)
_STAMP = re.compile(r"timestamp:\s*(\d{1,19})(?!\d)")

_MOST_YAML_BYTES = 2**24
"""A description of 1,248 lines takes 68 kB."""

_USED = frozenset(
    {
        "frames", "frame rate", "transmit frequency", "imaging depth", "focal depth", "tgc", "size", "type",
        "compression", "sampling rate", "delay samples", "lines", "roi", "vsound", "speed of sound", "probe",
        "focus",
    }
)  # fmt: skip


@dataclass(frozen=True)
class Lines:
    """Where the lines of a frame are received, in elements of the array, and how they are steered.

    Attributes
    ----------
    receive_element, transmit_element, angle_deg : ndarray, shape (line,)
    interpolated : bool
        True where the file gives the first line and the last.
    """

    receive_element: FloatArray
    transmit_element: FloatArray
    angle_deg: FloatArray
    interpolated: bool = False


@dataclass(frozen=True)
class Roi:
    """First and last line and sample that hold data."""

    start_line: int
    end_line: int
    start_sample: int
    end_sample: int


@dataclass(frozen=True)
class Receive:
    """Demodulation frequency at depth 0, at `filter_depth_mm`, and on a straight line between."""

    shallow_hz: float
    deep_hz: float
    filter_depth_mm: float

    def at_hz(self, depth_mm: float) -> float:
        """Demodulation frequency at a depth."""
        ends = ([0.0, self.filter_depth_mm], [self.shallow_hz, self.deep_hz])
        return float(np.interp(depth_mm, *ends))


@dataclass(frozen=True)
class Description:
    """What the yml of a raw file says; None where it does not.

    Attributes
    ----------
    kind : str
        ``"RF"``, ``"IQ"`` or ``"envelope"``, by the field `type`, whatever the file is called.
    delay_samples : float, optional
        Samples between transmission and the first sample.
    gain : tuple of pairs
        Depth in mm and gain in dB.
    element_pitch_mm, radius_mm : float, optional
        Of the probe, in files that give them.
    unused : tuple of str
        Fields that are not read.
    """

    where: str
    kind: str
    frames: int
    lines: int
    samples: int
    sample_bytes: int
    sampling_rate_hz: float
    delay_samples: float | None
    geometry: Lines
    compression: str = "none"
    frame_rate_hz: float | None = None
    transmit_frequency_hz: float | None = None
    imaging_depth_mm: float | None = None
    focal_depth_mm: float | None = None
    speed_of_sound_m_s: float | None = None
    element_pitch_mm: float | None = None
    radius_mm: float | None = None
    probe: str = ""
    gain: Curve = ()
    roi: Roi | None = None
    receive: Receive | None = None
    unused: tuple[str, ...] = field(default=())


def read_description(member: Member) -> Description:
    """Read the yml of a raw file.

    Raises
    ------
    FileError
        If it cannot be read, or is longer than any scanner writes.
    InvalidInputError
        Naming the field that is missing or has another unit.
    """
    where = member.where
    if member.size > _MOST_YAML_BYTES:
        raise FileError(f"{where}: expected at most {_MOST_YAML_BYTES} bytes, got {member.size}")
    text = member.text()
    gain_text = "".join(_GAIN_LINE.findall(text))
    documents = list(documents_of(_GAIN_LINE.sub(lambda found: "\n" * found[0].count("\n"), text), where))
    if len(documents) != 1:
        raise InvalidInputError(f"{where}: expected one document of fields, got {len(documents)}")
    fields = _Fields(documents[0], where)
    size = fields.below("size")
    lines = size.whole("number of lines")
    word = fields.values.get("type")
    if not isinstance(word, str) or word.strip().lower() not in _KINDS:
        raise InvalidInputError(f"{where}: type: expected RF, IQ or B pre-scan, got {shown(word)}")
    probe = fields.values.get("probe")
    probe_fields = _Fields(probe, f"{where}: probe") if isinstance(probe, dict) else None
    return Description(
        where=where,
        kind=_KINDS[word.strip().lower()],
        frames=fields.whole("frames"),
        lines=lines,
        samples=size.whole("samples per line"),
        sample_bytes=size.whole("sample size", "bytes"),
        sampling_rate_hz=fields.positive("sampling rate", "Hz"),
        delay_samples=fields.optional("delay samples", ""),
        geometry=_read_lines(fields, lines),
        compression=_compression(fields),
        frame_rate_hz=fields.optional("frame rate", "Hz"),
        transmit_frequency_hz=fields.optional("transmit frequency", "Hz"),
        imaging_depth_mm=fields.optional("imaging depth", "mm"),
        focal_depth_mm=fields.optional("focal depth", "mm"),
        speed_of_sound_m_s=fields.optional("vsound", "m/s") or fields.optional("speed of sound", "m/s"),
        element_pitch_mm=None if probe_fields is None else probe_fields.optional("pitch", "mm"),
        radius_mm=None if probe_fields is None else probe_fields.optional("radius", "mm"),
        probe=probe if isinstance(probe, str) else "",
        gain=tuple(_knots(gain_text, where)),
        roi=_read_roi(fields),
        receive=_read_receive(fields),
        unused=tuple(sorted(set(fields.values) - _USED)),
    )


def read_gains(member: Member) -> dict[int, Curve]:
    """Read the gain curve of each frame, by the frame's time in nanoseconds; empty where it was not changed.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If a time stamp or a curve makes no sense.
    """
    text, where = member.text(), member.where
    stamps = list(_STAMP.finditer(text))
    stops = [*(stamp.start() for stamp in stamps), len(text)][1:]
    curves: dict[int, Curve] = {}
    alike: dict[Curve, Curve] = {}
    for stamp, after in zip(stamps, stops, strict=bool(stamps)):
        time_ns = int(stamp[1])
        if time_ns in curves:
            raise InvalidInputError(f"{where}: expected one curve at {time_ns} ns, got two")
        curve = tuple(_knots(text[stamp.end() : after], f"{where}: timestamp {time_ns}"))
        curves[time_ns] = alike.setdefault(curve, curve)
    return curves


@dataclass(frozen=True)
class _Fields:
    """Fields of a mapping, read with their units; errors name the file and the field."""

    values: Mapping[str, Any]
    where: str

    def below(self, name: str) -> _Fields:
        inner = self.values.get(name)
        if not isinstance(inner, dict):
            raise InvalidInputError(f"{self.where}: {name}: expected fields, got {shown(inner)}")
        return _Fields(inner, f"{self.where}: {name}")

    def number(self, name: str, unit: str = "") -> float:
        return quantity(self.values.get(name), unit, f"{self.where}: {name}")

    def positive(self, name: str, unit: str) -> float:
        value = self.number(name, unit)
        if value <= 0:
            raise InvalidInputError(f"{self.where}: {name}: expected above zero, got {value:g}")
        return value

    def optional(self, name: str, unit: str) -> float | None:
        return None if self.values.get(name) is None else self.number(name, unit)

    def whole(self, name: str, unit: str = "") -> int:
        value = self.number(name, unit)
        if value != int(value) or not 0 <= value < 2**32:
            raise InvalidInputError(f"{self.where}: {name}: expected a whole number from 0, got {value:g}")
        return int(value)


def _compression(fields: _Fields) -> str:
    held = fields.values.get("compression", "none")
    if not isinstance(held, str):
        raise InvalidInputError(f"{fields.where}: compression: expected none, got {shown(held)}")
    return held


def _read_lines(fields: _Fields, count: int) -> Lines:
    where, entries = f"{fields.where}: lines", fields.values.get("lines")
    if not isinstance(entries, list) or not entries:
        raise InvalidInputError(f"{where}: expected a list of lines, got {shown(entries)}")
    names = (("rx element", ""), ("tx element", ""), ("angle", "deg"))
    rows = np.empty((len(entries), 3))
    for i, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise InvalidInputError(f"{where}[{i}]: expected fields, got {shown(entry)}")
        line = _Fields(entry, f"{where}[{i}]")
        rows[i] = [line.number(name, unit) for name, unit in names]
    if len(entries) == count:
        return Lines(*rows.T)
    if len(entries) != 2:
        raise InvalidInputError(f"{where}: expected {count} lines, got {len(entries)}")
    places = np.linspace(0.0, 1.0, count)[:, None]
    receive, transmit, angle = (rows[0] + places * (rows[1] - rows[0])).T
    return Lines(receive, transmit, angle, interpolated=True)


def _read_roi(fields: _Fields) -> Roi | None:
    if fields.values.get("roi") is None:
        return None
    roi = fields.below("roi")
    return Roi(*(roi.whole(name) for name in ("start line", "end line", "start sample", "end sample")))


def _read_receive(fields: _Fields) -> Receive | None:
    """Read the demodulation frequency; None in older files, and where it differs between foci or filters."""
    foci = fields.values.get("focus")
    found = set()
    for i, focus in enumerate(foci if isinstance(foci, list) else ()):
        filters = focus.get("receive") if isinstance(focus, dict) else None
        for entry in filters if isinstance(filters, list) else ():
            part = _Fields(entry if isinstance(entry, dict) else {}, f"{fields.where}: focus[{i}]: receive")
            ends = part.positive("shallowfreq", "Hz"), part.positive("deepfreq", "Hz")
            found.add(Receive(*ends, part.positive("filterdepth", "mm")))
    return found.pop() if len(found) == 1 else None


def _knots(text: str, where: str) -> Iterator[tuple[float, float]]:
    last_mm = -math.inf
    if text.count("{") != len(_KNOT.findall(text)):
        raise InvalidInputError(f"{where}: expected a gain as {{ 40.00mm, 26.00dB }}, got {text[:60]!r}")
    for found in _KNOT.finditer(text):
        depth_mm = quantity(f"{found[1]} mm", "mm", where)
        gain_db = quantity(found[2], "", where)
        if depth_mm <= last_mm:
            raise InvalidInputError(
                f"{where}: expected depths that rise, got {depth_mm:g} mm after {last_mm:g}"
            )
        last_mm = depth_mm
        yield depth_mm, gain_db
