"""A number that a recording gives, what is given over it, and the words for both.

Effective numbers are told with where they come from: "0.05 (given by import.toml, the file says 0.2)".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.files import PathLike
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings, settings_file, settings_for
from speckle3d.io.recordings import Row

CONTRADICTION = 0.01
"""Difference, as a share, above which `convert` tells that what is given is not what a file says."""

_UNITS = {"hz": "Hz", "mm": "mm", "db": "dB", "s": "m/s"}
_ASSUMED = "assumed"


@dataclass(frozen=True)
class Found:
    """A number that a recording gives, and where; None if it does not.

    Attributes
    ----------
    source : str
        As shown; beginning with "assumed" if no one says it.
    said_by : str
        Who says it, if it is not the recording.
    """

    value: Any = None
    source: str = ""
    said_by: str = "the file"

    @property
    def is_said(self) -> bool:
        """Whether it is known, and not assumed."""
        return self.value is not None and not self.source.startswith(_ASSUMED)


ASSUMED = {
    "speed_of_sound_m_s": Found(SPEED_OF_SOUND_M_S, _ASSUMED),
    "first_sample_depth_mm": Found(0.0, _ASSUMED),
}


def rows_of(path: PathLike, found: Mapping[str, Found], settings: ImportSettings) -> list[Row]:
    """Tell what each number is, by its setting's name, and where it comes from."""
    file = _beside(path)
    return [_row(name, one, settings, file) for name, one in found.items()]


def contradictions(path: PathLike, found: Mapping[str, Found], settings: ImportSettings) -> list[str]:
    """Tell each number that is given and is another than the recording says, by more than `CONTRADICTION`."""
    notes, file = [], _beside(path)
    for name, one in found.items():
        given = getattr(settings, name)
        if given is None or not one.is_said or not differs(given, one.value):
            continue
        spoken, unit = _spoken(name)
        notes.append(
            f"{spoken} {_shown(given, unit)} {unit}, {_given(name, given, file)}: {one.said_by} says "
            f"{_shown(one.value, unit)}{f' ({one.source})' if one.source else ''}"
        )
    return notes


def differs(given: Any, own: Any) -> bool:
    """Whether two values are further apart than `CONTRADICTION`."""
    return not np.allclose(given, own, rtol=CONTRADICTION, atol=0)


def _beside(path: PathLike) -> tuple[Path, ImportSettings] | None:
    """The settings file of a recording, and what is in it."""
    file = settings_file(path)
    return None if file is None else (file, settings_for(path))


def _given(name: str, value: Any, file: tuple[Path, ImportSettings] | None) -> str:
    held = None if file is None else getattr(file[1], name)
    return "given" if file is None or held != value else f"given by {file[0].name}"


def _row(name: str, one: Found, settings: ImportSettings, file: tuple[Path, ImportSettings] | None) -> Row:
    spoken, unit = _spoken(name)
    given = getattr(settings, name)
    own = None if one.value is None else _shown(one.value, unit)
    if given is None and own is None:
        return spoken, f"missing: --{name.replace('_', '-')}", ""
    if given is None:
        return spoken, f"{own} ({one.source})" if one.source else str(own), unit
    shown = _shown(given, unit)
    against = f", {one.said_by} says {own}" if one.is_said and own != shown else ""
    return spoken, f"{shown} ({_given(name, given, file)}{against})", unit


def _spoken(name: str) -> tuple[str, str]:
    """Words and unit of a setting, as they are shown."""
    *words, unit = name.split("_")
    if unit == "s":
        words = words[:-1]
    is_mega = unit == "hz" and words[0] != "frame"
    return " ".join(words), "MHz" if is_mega else _UNITS[unit]


def _shown(value: Any, unit: str) -> str:
    return " to ".join(f"{each / (1e6 if unit == 'MHz' else 1.0):.7g}" for each in np.ravel(value))
