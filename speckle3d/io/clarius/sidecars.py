"""Descriptions of raw files (yml).

The yml is YAML but for its gain curve, ``tgc: { 0.00mm, 23.00dB }{ 40.00mm, 26.00dB }``, which is left out.
Scalars stay the text that is in the file, so that ``010`` is ten, and every number is read with its unit.

References
----------
.. [1] clariusdev/research, "Raw Data Format" (docs/raw-data-format.md), ".yml metadata".
.. [2] clariusdev/research, "Low-Level Parameters" (docs/low-level-parameters.md): `rxFreqShallow`, "start
   demodulation frequency", and `rxFreqDeep`.
"""

from __future__ import annotations

import re
from functools import cached_property
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
    "deg": {"°": 1.0, "deg": 1.0},
}


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
        raise InvalidInputError(f"{where}: expected fields, got a {type(document).__name__}")
    return document


class Description:
    """The yml of a raw file, asked for its fields by the names that lead to them.

    Attributes
    ----------
    kind : str
        ``"RF"``, ``"IQ"`` or ``"envelope"``, by the field `type`, whatever the file is called.

    Raises
    ------
    FileError
        If it cannot be read.
    InvalidInputError
        If it describes no raw file.
    """

    def __init__(self, member: Member) -> None:
        self.where = member.where
        self.values = parsed(_GAIN_LINE.sub("", member.text()), self.where)
        self.kind = _KINDS.get(self.text("type").strip().lower(), "")
        if not self.kind or self.text("compression").lower() not in ("", "none"):
            raise InvalidInputError(
                f"{self.where}: type, compression: expected RF, IQ or B pre-scan, and none, got "
                f"{self.text('type')} and {self.text('compression')}"
            )
        self.lines = int(self.number("size", "number of lines"))
        self.samples = int(self.number("size", "samples per line"))

    def field(self, *names: str | int) -> Any:
        """Value of a field; None where there is none."""
        value: Any = self.values
        for name in names:
            is_inside = name in value if isinstance(value, dict) else isinstance(value, list)
            value = value[name] if is_inside else None
        return value

    def text(self, *names: str | int) -> str:
        """Text of a field as it may be shown; empty where there is none."""
        value = self.field(*names)
        return printable(value[:60]) if isinstance(value, str) else ""

    def count(self, *names: str | int) -> int:
        """Length of a list; 0 where there is none."""
        value = self.field(*names)
        return len(value) if isinstance(value, list) else 0

    def number(self, *names: str | int, unit: str = "") -> float:
        """A number with its unit, as ``"60 MHz"``, in the base unit `unit`.

        Raises
        ------
        InvalidInputError
            Naming the field that is missing or has another unit.
        """
        parts = _NUMBER.fullmatch(self.text(*names))
        factor = None if parts is None else _UNITS[unit].get(parts[2].lower())
        value = np.nan if parts is None or factor is None else float(parts[1]) * factor
        if not np.isfinite(value) or (unit == "Hz" and value <= 0):
            got = self.text(*names) or f"a {type(self.field(*names)).__name__}"
            expected = f"a number of {unit}" if unit else "a number"
            place = ": ".join(map(str, names))
            raise InvalidInputError(f"{self.where}: {place}: expected {expected}, got {got}")
        return value

    def optional(self, *names: str | int, unit: str = "") -> float | None:
        """A number, or None where there is none."""
        return None if self.field(*names) in (None, "", "~") else self.number(*names, unit=unit)

    @property
    def probe(self) -> str:
        """Model of the probe; empty where only its measures, or nothing, is said."""
        return self.text("probe")

    @cached_property
    def places(self) -> FloatArray:
        """Element where each line is received and its angle in degrees, shape (line, 2).

        Files may give the first and the last alone.
        """
        rows = [
            (self.number("lines", i, "rx element"), self.number("lines", i, "angle", unit="deg"))
            for i in range(self.count("lines"))
        ]
        if len(rows) not in (2, self.lines) or not rows:
            raise InvalidInputError(f"{self.where}: lines: expected {self.lines} lines, got {len(rows)}")
        if len(rows) == self.lines:
            return np.array(rows)
        return np.asarray(np.linspace(np.array(rows[0]), np.array(rows[1]), self.lines))

    @property
    def region(self) -> tuple[slice, slice] | None:
        """Lines and samples of the region of interest."""
        if not self.field("roi"):
            return None
        parts = []
        for name, length in (("line", self.lines), ("sample", self.samples)):
            start, end = (int(self.number("roi", f"{side} {name}")) for side in ("start", "end"))
            if not 0 <= start < end < length:
                raise InvalidInputError(
                    f"{self.where}: roi: expected {name}s within {length}, got {start} to {end}"
                )
            parts.append(slice(start, end + 1))
        return parts[0], parts[1]

    @property
    def receive(self) -> tuple[float, float, float] | None:
        """Demodulation frequency at depth 0, Hz, at a depth, and that depth, mm; linear between [2]_.

        None in older files, and where it differs between foci or filters.
        """
        fields = ("shallowfreq", "Hz"), ("deepfreq", "Hz"), ("filterdepth", "mm")
        ends = {
            tuple(self.number("focus", i, "receive", k, name, unit=unit) for name, unit in fields)
            for i in range(self.count("focus"))
            for k in range(self.count("focus", i, "receive"))
        }
        if len(ends) != 1:
            return None
        shallow_hz, deep_hz, depth_mm = ends.pop()
        return shallow_hz, deep_hz, depth_mm
