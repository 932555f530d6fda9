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
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AliasChoices, BaseModel, BeforeValidator, Field

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.io.import_settings import LEAST_HZ

_KINDS = {"rf": "RF", "iq": "IQ", "b pre-scan": "envelope", "envelope": "envelope", "b": "envelope"}
_GAIN_LINE = re.compile(r"^tgc:.*(?:\n[ \t]+-.*)*$", re.MULTILINE)
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\s\d]*)\s*")
_SIZES = {"khz": 1e3, "mhz": 1e6, "cm": 10.0, "um": 1e-3, "µm": 1e-3}
"""Of units in Hz and mm."""
_UNITS = {**dict.fromkeys(("", "hz", "mm", "m/s", "°", "deg"), 1.0), **_SIZES}


def yml_fields(text: str, where: str) -> dict[str, Any]:
    """Parse a YAML document of fields; their values are text, lists, or mappings.

    Raises
    ------
    InvalidInputError
        If it is no YAML or holds other things, or PyYAML is not installed.
    """
    yaml = extra_module("yaml", "clarius", "a package of a Clarius scanner")
    try:
        document = yaml.load(_GAIN_LINE.sub("", text), Loader=getattr(yaml, "CBaseLoader", yaml.BaseLoader))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InvalidInputError(f"{where}: expected YAML, got an error: {error!s:.200}") from error
    if not isinstance(document, dict):
        raise InvalidInputError(f"{where}: expected fields, got a {type(document).__name__}")
    return document


def _quantity(text: object) -> float | None:
    """Parse text as ``60 MHz`` into Hz, mm, m/s or degrees; None if it is empty."""
    if text in (None, "", "~"):
        return None
    parts = _NUMBER.fullmatch(str(text).replace(",", "."))
    value = math.nan if parts is None else float(parts[1]) * _UNITS.get(parts[2].lower(), math.nan)
    if not math.isfinite(value):
        raise ValueError("expected a number and its unit")
    return value


Quantity = Annotated[float, BeforeValidator(_quantity)]
Count = Annotated[int, BeforeValidator(_quantity)]
Optional = Annotated[float | None, BeforeValidator(_quantity)]
_OR_EMPTY = BeforeValidator(lambda value: value or [])


class _Size(BaseModel):
    lines: Count = Field(alias="number of lines")
    samples: Count = Field(alias="samples per line")


class _Line(BaseModel):
    element: Quantity = Field(alias="rx element")
    angle: Quantity


class _Filter(BaseModel):
    shallowfreq: Quantity
    deepfreq: Quantity
    filterdepth: Quantity


class _Focus(BaseModel):
    receive: Annotated[list[_Filter], _OR_EMPTY] = []


class _Probe(BaseModel):
    """Model of a probe, or its measures in mm."""

    model: str = ""
    radius: Optional = None
    pitch: Optional = None
    elements: Optional = None


class Description(BaseModel):
    """The yml of a raw file.

    Attributes
    ----------
    kind : str
        ``"RF"``, ``"IQ"`` or ``"envelope"``, by the field `type`, whatever the file is called.
    """

    kind: Annotated[
        Literal["RF", "IQ", "envelope"],
        BeforeValidator(lambda text: _KINDS.get(str(text).strip().lower(), text)),
    ] = Field(alias="type")
    compression: Literal["", "none"] = ""
    frames: Count
    size: _Size
    lines: list[_Line]
    rate_hz: Quantity = Field(alias="sampling rate", ge=LEAST_HZ)
    delay: Optional = Field(None, alias="delay samples")
    transmit_hz: Optional = Field(None, alias="transmit frequency")
    speed_m_s: Optional = Field(None, validation_alias=AliasChoices("vsound", "speed of sound"))
    focus: Annotated[list[_Focus], _OR_EMPTY] = []
    probe: Annotated[
        _Probe, BeforeValidator(lambda value: {"model": value} if isinstance(value, str) else value)
    ] = _Probe()

    @property
    def places(self) -> FloatArray:
        """Element where each line is received and its angle in degrees, shape (line, 2).

        Files may give the first and the last alone.
        """
        rows = np.array([(line.element, line.angle) for line in self.lines]).reshape(-1, 2)
        if len(rows) == 2:
            return np.asarray(np.linspace(rows[0], rows[1], self.size.lines))
        if len(rows) != self.size.lines or not len(rows):
            raise InvalidInputError(f"lines: expected {self.size.lines} lines, got {len(rows)}")
        return rows

    @property
    def receive(self) -> tuple[float, float, float] | None:
        """Demodulation frequency at depth 0, Hz, at a depth, and that depth, mm; linear between [2]_.

        None in older files, and where it differs between foci or filters.
        """
        filters = (part for focus in self.focus for part in focus.receive)
        ends = {(part.shallowfreq, part.deepfreq, part.filterdepth) for part in filters}
        return ends.pop() if len(ends) == 1 else None
