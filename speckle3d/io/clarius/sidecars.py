"""Descriptions of raw files (yml) and their gain by frame (tgc).

The yml is YAML but for its gain curve, ``tgc: { 0.00mm, 23.00dB }{ 40.00mm, 26.00dB }``, which is read apart.
Scalars stay the text that is in the file, so that ``010`` is ten, and every number is read with its unit.

References
----------
.. [1] clariusdev/research, "Raw Data Format" (docs/raw-data-format.md), ".yml metadata".
.. [2] clariusdev/research, "Low-Level Parameters" (docs/low-level-parameters.md): `rxFreqShallow`, "start
   demodulation frequency", and `rxFreqDeep`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.core.printable import printable
from speckle3d.io.clarius.package import Member

Curve = tuple[tuple[float, float], ...]
"""Depth in mm and gain in dB of each knot of a gain curve."""

_KINDS = {"rf": "RF", "iq": "IQ", "b pre-scan": "envelope", "envelope": "envelope", "b": "envelope"}
_KNOT = re.compile(r"\{\s*([-+.\deE]+)\s*mm\s*,\s*([-+.\deE]+)\s*dB\s*\}")
_GAIN_LINE = re.compile(r"^tgc:.*(?:\n[ \t]+-.*)*$", re.MULTILINE)
_STAMP = re.compile(r"timestamp:\s*(\d{1,19})(?!\d)")
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\s\d]*)\s*")
_UNITS = {
    "": {"": 1.0},
    "Hz": {"hz": 1.0, "khz": 1e3, "mhz": 1e6},
    "mm": {"mm": 1.0, "cm": 10.0, "um": 1e-3, "µm": 1e-3},
    "m/s": {"m/s": 1.0},
    "bytes": {"bytes": 1.0, "byte": 1.0},
    "deg": {"°": 1.0, "deg": 1.0},
}
_USED = frozenset(
    {
        "frames", "frame rate", "transmit frequency", "imaging depth", "focal depth", "tgc", "size", "type",
        "compression", "sampling rate", "delay samples", "lines", "roi", "vsound", "speed of sound", "probe",
        "focus",
    }
)  # fmt: skip
_LONGEST = 60
"""Letters of a wrong value that a message shows."""


def fields_of(text: str, where: str) -> Mapping[str, Any]:
    """Parse a YAML document of fields; their values are text, lists, or mappings.

    Raises
    ------
    InvalidInputError
        If it is no YAML or holds other things, or PyYAML is not installed.
    """
    yaml = extra_module("yaml", "clarius", "a package of a Clarius scanner")
    try:
        document = yaml.load(text, Loader=getattr(yaml, "CBaseLoader", yaml.BaseLoader))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        words = " ".join(str(error).split())[:200]
        raise InvalidInputError(f"{where}: expected YAML, got an error: {words}") from error
    if not isinstance(document, dict):
        raise InvalidInputError(f"{where}: expected fields, got {_shown(document)}")
    return document


@dataclass(frozen=True)
class Fields:
    """Fields of a mapping, read with their units; errors name the file and the field."""

    values: Mapping[str, Any]
    where: str

    def below(self, name: str) -> Fields:
        """Fields of a field."""
        inner = self.values.get(name)
        if not isinstance(inner, dict):
            raise InvalidInputError(f"{self.where}: {name}: expected fields, got {_shown(inner)}")
        return Fields(inner, f"{self.where}: {name}")

    def number(self, name: str, unit: str = "", least: float = -math.inf) -> float:
        """A number with its unit, as ``"60 MHz"``, in the base unit `unit`."""
        value = self.values.get(name)
        parts = _NUMBER.fullmatch(value) if isinstance(value, str) and len(value) < _LONGEST else None
        factor = None if parts is None else _UNITS[unit].get(parts[2].lower())
        if parts is None or factor is None or not least <= float(parts[1]) < math.inf:
            above = f" from {least:g}" if least > -math.inf else ""
            expected = f"a number{f' of {unit}' if unit else ''}{above}"
            raise InvalidInputError(f"{self.where}: {name}: expected {expected}, got {_shown(value)}")
        return float(parts[1]) * factor

    def optional(self, name: str, unit: str = "") -> float | None:
        """A number, or None where there is none."""
        return None if self.values.get(name) in (None, "", "~") else self.number(name, unit)

    def whole(self, name: str, unit: str = "") -> int:
        """A whole number from 0."""
        value = self.number(name, unit, 0.0)
        if value != int(value):
            raise InvalidInputError(f"{self.where}: {name}: expected a whole number, got {value:g}")
        return int(value)


def _shown(value: object) -> str:
    if isinstance(value, str):
        return repr(printable(value[:_LONGEST])) + ("..." if len(value) > _LONGEST else "")
    return "fields" if isinstance(value, dict) else "a list" if isinstance(value, list) else "nothing"


@dataclass(frozen=True)
class Roi:
    """First and last line and sample that hold data."""

    start_line: int
    end_line: int
    start_sample: int
    end_sample: int


@dataclass(frozen=True)
class Receive:
    """Demodulation frequency at depth 0, at `filter_depth_mm`, and on a straight line between [2]_."""

    shallow_hz: float
    deep_hz: float
    filter_depth_mm: float

    def at_hz(self, depth_mm: FloatArray | float) -> FloatArray:
        """Demodulation frequency at depths."""
        return np.asarray(np.interp(depth_mm, [0.0, self.filter_depth_mm], [self.shallow_hz, self.deep_hz]))


@dataclass(frozen=True)
class Description:
    """What the yml of a raw file says; None where it does not.

    Attributes
    ----------
    kind : str
        ``"RF"``, ``"IQ"`` or ``"envelope"``, by the field `type`, whatever the file is called.
    receive_element, angle_deg : ndarray, shape (line,)
        Where lines are received, in elements of the array, and how they are steered.
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
    receive_element: FloatArray
    angle_deg: FloatArray
    delay_samples: float | None
    frame_rate_hz: float | None
    transmit_frequency_hz: float | None
    imaging_depth_mm: float | None
    speed_of_sound_m_s: float | None
    element_pitch_mm: float | None
    radius_mm: float | None
    probe: str
    gain: Curve
    roi: Roi | None
    receive: Receive | None
    unused: tuple[str, ...]


def read_description(member: Member) -> Description:
    """Read the yml of a raw file.

    Raises
    ------
    FileError
        If it cannot be read.
    InvalidInputError
        Naming the field that is missing or has another unit.
    """
    where, text = member.where, member.text()
    gain_text = "".join(_GAIN_LINE.findall(text))
    fields = Fields(fields_of(_GAIN_LINE.sub("", text), where), where)
    size = fields.below("size")
    word = fields.values.get("type")
    if not isinstance(word, str) or word.strip().lower() not in _KINDS:
        raise InvalidInputError(f"{where}: type: expected RF, IQ or B pre-scan, got {_shown(word)}")
    packing = fields.values.get("compression", "none")
    if str(packing).lower() != "none":
        raise InvalidInputError(
            f"{where}: compression: expected none, got {_shown(packing)}: frames are not decoded"
        )
    probe = fields.values.get("probe")
    of_probe = Fields(probe if isinstance(probe, dict) else {}, f"{where}: probe")
    lines = size.whole("number of lines")
    samples = size.whole("samples per line")
    element, angle = _lines(fields, lines)
    return Description(
        where=where,
        kind=_KINDS[word.strip().lower()],
        frames=fields.whole("frames"),
        lines=lines,
        samples=samples,
        sample_bytes=size.whole("sample size", "bytes"),
        sampling_rate_hz=fields.number("sampling rate", "Hz", 1.0),
        receive_element=element,
        angle_deg=angle,
        delay_samples=fields.optional("delay samples"),
        frame_rate_hz=fields.optional("frame rate", "Hz"),
        transmit_frequency_hz=fields.optional("transmit frequency", "Hz"),
        imaging_depth_mm=fields.optional("imaging depth", "mm"),
        speed_of_sound_m_s=fields.optional("vsound", "m/s") or fields.optional("speed of sound", "m/s"),
        element_pitch_mm=of_probe.optional("pitch", "mm"),
        radius_mm=of_probe.optional("radius", "mm"),
        probe=probe if isinstance(probe, str) else "",
        gain=_knots(gain_text, where),
        roi=_roi(fields, lines, samples),
        receive=_receive(fields),
        unused=tuple(sorted(set(map(str, fields.values)) - _USED)),
    )


def read_gains(member: Member) -> dict[int, Curve]:
    """Read the gain curve of each frame, by the frame's time in nanoseconds; empty where it was not changed.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If a curve makes no sense.
    """
    text, where = member.text(), member.where
    _, *parts = _STAMP.split(text)
    curves: dict[int, Curve] = {}
    alike: dict[Curve, Curve] = {}
    for stamp, part in zip(parts[::2], parts[1::2], strict=True):
        curve = _knots(part, f"{where}: timestamp {stamp}")
        curves[int(stamp)] = alike.setdefault(curve, curve)
    return curves


def _lines(fields: Fields, count: int) -> tuple[FloatArray, FloatArray]:
    """Places and angles of the lines; files may give the first and the last alone."""
    where, entries = f"{fields.where}: lines", fields.values.get("lines")
    if not isinstance(entries, list) or len(entries) not in (2, count) or not entries:
        got = len(entries) if isinstance(entries, list) else _shown(entries)
        raise InvalidInputError(f"{where}: expected {count} lines, got {got}")
    rows = np.empty((len(entries), 2))
    for i, entry in enumerate(entries):
        line = Fields(entry if isinstance(entry, dict) else {}, f"{where}[{i}]")
        rows[i] = line.number("rx element"), line.number("angle", "deg")
    if len(rows) != count:
        rows = rows[0] + np.linspace(0.0, 1.0, count)[:, None] * (rows[1] - rows[0])
    return rows[:, 0], rows[:, 1]


def _roi(fields: Fields, lines: int, samples: int) -> Roi | None:
    if fields.values.get("roi") in (None, ""):
        return None
    below = fields.below("roi")
    roi = Roi(*(below.whole(name) for name in ("start line", "end line", "start sample", "end sample")))
    if not (roi.start_line < roi.end_line < lines and roi.start_sample < roi.end_sample < samples):
        raise InvalidInputError(
            f"{below.where}: expected one within {lines} lines of {samples} samples, got {roi}"
        )
    return roi


def _receive(fields: Fields) -> Receive | None:
    """Read the demodulation frequency; None in older files, and where it differs between foci or filters."""
    foci = fields.values.get("focus")
    ends = set()
    for i, focus in enumerate(foci if isinstance(foci, list) else ()):
        filters = focus.get("receive") if isinstance(focus, dict) else None
        for entry in filters if isinstance(filters, list) else ():
            part = Fields(entry if isinstance(entry, dict) else {}, f"{fields.where}: focus[{i}]: receive")
            names = ("shallowfreq", "Hz"), ("deepfreq", "Hz"), ("filterdepth", "mm")
            ends.add(Receive(*(part.number(name, unit, 1e-6) for name, unit in names)))
    return ends.pop() if len(ends) == 1 else None


def _knots(text: str, where: str) -> Curve:
    try:
        knots = tuple((float(depth), float(gain)) for depth, gain in _KNOT.findall(text))
    except ValueError:
        knots = ()
    depths = [depth for depth, _ in knots]
    if len(knots) != text.count("{") or sorted(set(depths)) != depths:
        raise InvalidInputError(
            f"{where}: expected a gain as {{ 40.00mm, 26.00dB }} at depths that rise, got {text[:_LONGEST]!r}"
        )
    return knots
