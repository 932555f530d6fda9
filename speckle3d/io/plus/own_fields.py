"""Fields that this package adds to the sequences it writes, so that reading them back asks for nothing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from speckle3d.core.sweep import BModeSettings, RFSettings, Sweep
from speckle3d.io.plus.record import number_text
from speckle3d.io.text import numbers

PREFIX = "Speckle3D_"

_COUNTS = {
    "sampling_rate_hz": 1,
    "vector_pitch_mm": 1,
    "speed_of_sound_m_s": 1,
    "centre_frequency_hz": 1,
    "bandwidth_hz": 2,
    "demodulation_frequency_hz": 1,
    "first_sample_depth_mm": 1,
    "column_pitch_mm": 1,
    "row_spacing_mm": 1,
    "dynamic_range_db": 1,
    "full_scale": 1,
}
"""How many numbers a field holds; all are named as in `ImportSettings` and `BModeSettings`."""


def own_values(path: str, fields: Mapping[str, str]) -> dict[str, Any]:
    """Read the values that this package wrote; by name, without the prefix.

    Raises
    ------
    InvalidInputError
        Naming the field that does not make sense.
    """
    held: dict[str, Any] = {}
    for name, count in _COUNTS.items():
        if (text := fields.get(PREFIX + name)) is not None:
            values = numbers(text, count, f"{path}: {PREFIX}{name}")
            held[name] = values[0] if count == 1 else values
    if (probe := fields.get(f"{PREFIX}probe")) is not None:
        held["probe"] = probe
    return held


def own_fields(sweep: Sweep) -> dict[str, str]:
    """Fields that `own_values` reads back."""
    grid, signal = sweep.grid, sweep.signal
    values: dict[str, Any] = {name: value for name, value in vars(signal).items() if value is not None}
    values["first_sample_depth_mm"] = grid.first_sample_depth_mm
    if isinstance(signal, RFSettings):
        values["vector_pitch_mm"] = grid.vector_pitch_mm
    else:
        assert isinstance(signal, BModeSettings)
        values |= {"column_pitch_mm": grid.vector_pitch_mm, "row_spacing_mm": grid.sample_spacing_mm}
    texts = {
        name: " ".join(map(number_text, value)) if isinstance(value, tuple) else number_text(value)
        for name, value in values.items()
    }
    if sweep.probe:
        texts["probe"] = " ".join(sweep.probe.split())
    return {PREFIX + name: text for name, text in texts.items()}
