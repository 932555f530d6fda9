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

import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.io.clarius.package import Member
from speckle3d.io.hdf5 import reading

_KINDS = {"rf": "RF", "iq": "IQ", "b pre-scan": "envelope", "envelope": "envelope", "b": "envelope"}
_GAIN_LINE = re.compile(r"^tgc:.*(?:\n[ \t]+-.*)*$", re.MULTILINE)
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\s\d]*)\s*")
_SIZES = {"khz": 1e3, "mhz": 1e6, "cm": 10.0, "um": 1e-3, "µm": 1e-3}
"""Of units in Hz and mm."""
_UNITS = {**dict.fromkeys(("", "hz", "mm", "m/s", "°", "deg"), 1.0), **_SIZES}


@dataclass(frozen=True)
class Description:
    """The yml of a raw file: fields that are text, lists, or mappings, and their place for messages."""

    fields: dict[str, Any]
    where: str

    @classmethod
    def of(cls, member: Member) -> Description:
        """Parse a YAML document of fields.

        Raises
        ------
        InvalidInputError
            If it is no YAML or holds other things, or PyYAML is not installed.
        """
        yaml, where = extra_module("yaml", "clarius", "a package of a Clarius scanner"), member.where
        text, loader = _GAIN_LINE.sub("", member.text()), getattr(yaml, "CBaseLoader", yaml.BaseLoader)
        with reading(where):
            fields = yaml.load(text, Loader=loader)
        if not isinstance(fields, dict):
            raise InvalidInputError(f"{where}: expected fields, got a {type(fields).__name__}")
        return cls(fields, where)

    @property
    def kind(self) -> str:
        """Of samples: RF, IQ or envelope by the field `type`, whatever the file is called."""
        packing, text = self.fields.get("compression"), str(self.fields.get("type"))
        kind = _KINDS.get(text.strip().lower())
        if kind is None or packing not in (None, "", "none"):
            raise InvalidInputError(
                f"{self.where}: type: expected {', '.join(_KINDS)}, not compressed, got {text}, {packing}"
            )
        return kind

    @property
    def model(self) -> str:
        """The probe's."""
        probe = self.fields.get("probe") or ""
        return probe if isinstance(probe, str) else str(probe.get("model", ""))

    def number(self, *place: str, of: Any = None) -> float | None:
        """Number of nested fields, as ``60 MHz``, in Hz, mm, m/s or degrees; None where there is none."""
        value = self.fields if of is None else of
        for name in place:
            value = value.get(name) if isinstance(value, dict) else None
        if value in (None, "", "~"):
            return None
        parts = _NUMBER.fullmatch(str(value).replace(",", "."))
        number = math.nan if parts is None else float(parts[1]) * _UNITS.get(parts[2].lower(), math.nan)
        if not math.isfinite(number):
            words = f"{self.where}: {': '.join(place)}"
            raise InvalidInputError(f"{words}: expected a number and its unit, got {value!r:.40}")
        return number

    def require(self, *place: str, of: Any = None) -> float:
        """Number of nested fields that must be there."""
        if (number := self.number(*place, of=of)) is None:
            raise InvalidInputError(f"{self.where}: {': '.join(place)}: expected a number, got none")
        return number

    def places(self, count: int) -> FloatArray:
        """Element where each line is received and its angle in degrees, shape (line, 2).

        Files may give the first and the last alone.
        """
        lines = self.fields.get("lines") or ()
        rows = np.array([[self.require(name, of=line) for name in ("rx element", "angle")] for line in lines])
        if len(rows) == 2:
            return np.linspace(rows[0], rows[1], count)
        if len(rows) != count:
            raise InvalidInputError(f"{self.where}: lines: expected {count} lines, got {len(rows)}")
        return rows

    @property
    def receive(self) -> tuple[float, ...] | None:
        """Demodulation frequency at depth 0, Hz, at a depth, and that depth, mm; linear between [2]_.

        None in older files, and where it differs between foci or filters.
        """
        filters = [part for focus in self.fields.get("focus") or () for part in focus.get("receive") or ()]
        names = "shallowfreq", "deepfreq", "filterdepth"
        ends = {tuple(self.require(name, of=part) for name in names) for part in filters}
        return ends.pop() if len(ends) == 1 else None
