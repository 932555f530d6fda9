"""Descriptions of raw files (yml) and their gain by frame (tgc).

The yml is YAML but for its gain curve, ``tgc: { 0.00mm, 23.00dB }{ 40.00mm, 26.00dB }``, which is left out.
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

_KINDS = {"rf": "RF", "iq": "IQ", "b pre-scan": "envelope", "envelope": "envelope", "b": "envelope"}
_GAIN_LINE = re.compile(r"^tgc:.*(?:\n[ \t]+-.*)*$", re.MULTILINE)
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\s\d]*)\s*")
_UNITS = {
    "": {"": 1.0},
    "Hz": {"hz": 1.0, "khz": 1e3, "mhz": 1e6},
    "mm": {"mm": 1.0, "cm": 10.0, "um": 1e-3, "µm": 1e-3},
    "m/s": {"m/s": 1.0},
    "bytes": {"bytes": 1.0, "byte": 1.0},
    "deg": {"°": 1.0, "deg": 1.0},
}
_LONGEST = 60
"""Letters of a value that a message shows."""


def parsed(text: str, where: str) -> dict[str, Any]:
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
        """Fields of a field; none where it is missing."""
        return self._fields(self.values.get(name) or {}, name)

    def listed(self, name: str) -> list[Fields]:
        """Fields of each entry of a list; none where it is missing."""
        entries = self.values.get(name)
        listed = entries if isinstance(entries, list) else []
        return [self._fields(entry, f"{name}[{i}]") for i, entry in enumerate(listed)]

    def _fields(self, inner: Any, name: str) -> Fields:
        if not isinstance(inner, dict):
            raise InvalidInputError(f"{self.where}: {name}: expected fields, got {_shown(inner)}")
        return Fields(inner, f"{self.where}: {name}")

    def number(self, name: str, unit: str = "", least: float = -math.inf) -> float:
        """A number with its unit, as ``"60 MHz"``, in the base unit `unit`."""
        value = self.values.get(name)
        parts = _NUMBER.fullmatch(value) if isinstance(value, str) else None
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
    return "nothing" if value is None else f"a {type(value).__name__}"


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
class Description(Fields):
    """The yml of a raw file.

    Attributes
    ----------
    kind : str
        ``"RF"``, ``"IQ"`` or ``"envelope"``, by the field `type`, whatever the file is called.
    """

    kind: str
    lines: int
    samples: int

    @classmethod
    def of(cls, member: Member) -> Description:
        """Read the yml of a raw file.

        Raises
        ------
        FileError
            If it cannot be read.
        InvalidInputError
            Naming the field that is missing or has another unit.
        """
        where, text = member.where, member.text()
        fields = Fields(parsed(_GAIN_LINE.sub("", text), where), where)
        kind = _KINDS.get(str(fields.values.get("type")).strip().lower())
        packing = fields.values.get("compression", "none")
        if kind is None or str(packing).lower() != "none":
            raise InvalidInputError(
                f"{where}: type, compression: expected RF, IQ or B pre-scan, and none, got "
                f"{_shown(fields.values.get('type'))} and {_shown(packing)}"
            )
        size = fields.below("size")
        return cls(fields.values, where, kind, size.whole("number of lines"), size.whole("samples per line"))

    @property
    def probe(self) -> str:
        """Model of the probe; empty where only its measures, or nothing, is said."""
        named = self.values.get("probe")
        return named if isinstance(named, str) else ""

    def of_probe(self, name: str) -> float | None:
        """A measure of the probe in mm."""
        return None if self.probe else self.below("probe").optional(name, "mm")

    @property
    def places(self) -> FloatArray:
        """Element where each line is received and its angle in degrees, shape (line, 2).

        Files may give the first and the last alone.
        """
        rows = np.array(
            [(line.number("rx element"), line.number("angle", "deg")) for line in self.listed("lines")]
        )
        if len(rows) not in (2, self.lines) or not self.lines:
            raise InvalidInputError(f"{self.where}: lines: expected {self.lines} lines, got {len(rows)}")
        if len(rows) == self.lines:
            return rows
        return np.asarray(rows[0] + np.linspace(0.0, 1.0, self.lines)[:, None] * (rows[1] - rows[0]))

    @property
    def region(self) -> tuple[slice, slice] | None:
        """Lines and samples of the region of interest."""
        if not self.values.get("roi"):
            return None
        roi, parts = self.below("roi"), []
        for name, length in (("line", self.lines), ("sample", self.samples)):
            start, end = roi.whole(f"start {name}"), roi.whole(f"end {name}")
            if not start < end < length:
                got = f"{start} to {end}"
                raise InvalidInputError(f"{roi.where}: expected {name}s within {length}, got {got}")
            parts.append(slice(start, end + 1))
        return parts[0], parts[1]

    @property
    def receive(self) -> Receive | None:
        """Demodulation; None in older files, and where it differs between foci or filters."""
        names = ("shallowfreq", "Hz"), ("deepfreq", "Hz"), ("filterdepth", "mm")
        ends = {
            Receive(*(part.number(name, unit, 1e-6) for name, unit in names))
            for focus in self.listed("focus")
            for part in focus.listed("receive")
        }
        return ends.pop() if len(ends) == 1 else None


def read_gains(member: Member) -> list[str]:
    """Gain curves of the frames that a file tells of, as text; empty where it was not changed."""
    parts = re.split(r"timestamp:\s*\d+", member.text())[1:]
    return [" ".join(re.findall(r"\{.*?\}", part)) for part in parts]
