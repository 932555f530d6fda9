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
from speckle3d.io.import_settings import LEAST_HZ

_KINDS = {"rf": "RF", "iq": "IQ", "b pre-scan": "envelope", "envelope": "envelope", "b": "envelope"}
_GAIN_LINE = re.compile(r"^tgc:.*(?:\n[ \t]+-.*)*$", re.MULTILINE)
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\s\d]*)\s*")
_SIZES = {"khz": 1e3, "mhz": 1e6, "cm": 10.0, "um": 1e-3, "µm": 1e-3}
"""Of units in Hz and mm."""
_UNITS = {**dict.fromkeys(("", "hz", "mm", "m/s", "°", "deg"), 1.0), **_SIZES}


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
    rate_hz : float
        Sampling rate.

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
        self.kind, packing = _KINDS.get(self.text("type").strip().lower(), ""), self.text("compression")
        self.rate_hz = self.number("sampling rate")
        if not self.kind or packing.lower() not in ("", "none") or self.rate_hz < LEAST_HZ:
            raise InvalidInputError(
                f"{self.where}: type, compression, sampling rate: expected RF, IQ or B pre-scan, none, and a "
                f"rate in MHz, got {self.text('type')}, {packing} and {self.rate_hz:g} Hz"
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

    def rows(self, *names: str | int) -> range:
        """Numbers of a list's items; none where there is no list."""
        value = self.field(*names)
        return range(len(value) if isinstance(value, list) else 0)

    def number(self, *names: str | int) -> float:
        """A number in Hz, mm, m/s or degrees, as of ``"60 MHz"``.

        Raises
        ------
        InvalidInputError
            Naming the field that is missing or has another unit.
        """
        parts = _NUMBER.fullmatch(self.text(*names))
        value = np.nan if parts is None else float(parts[1]) * _UNITS.get(parts[2].lower(), np.nan)
        if not np.isfinite(value):
            got = self.text(*names) or f"a {type(self.field(*names)).__name__}"
            place = ": ".join(map(str, names))
            raise InvalidInputError(f"{self.where}: {place}: expected a number and its unit, got {got}")
        return value

    def optional(self, *names: str | int) -> float | None:
        """A number, or None where there is none."""
        return None if self.field(*names) in (None, "", "~") else self.number(*names)

    @cached_property
    def places(self) -> FloatArray:
        """Element where each line is received and its angle in degrees, shape (line, 2).

        Files may give the first and the last alone.
        """
        names = ("rx element", "angle")
        rows = [[self.number("lines", i, name) for name in names] for i in self.rows("lines")]
        if len(rows) == 2:
            return np.asarray(np.linspace(*np.array(rows), self.lines))
        if len(rows) != self.lines or not rows:
            raise InvalidInputError(f"{self.where}: lines: expected {self.lines} lines, got {len(rows)}")
        return np.array(rows)

    @property
    def receive(self) -> tuple[float, ...] | None:
        """Demodulation frequency at depth 0, Hz, at a depth, and that depth, mm; linear between [2]_.

        None in older files, and where it differs between foci or filters.
        """
        fields = ("shallowfreq", "deepfreq", "filterdepth")
        ends = {
            tuple(self.number("focus", i, "receive", k, name) for name in fields)
            for i in self.rows("focus")
            for k in self.rows("focus", i, "receive")
        }
        return ends.pop() if len(ends) == 1 else None
