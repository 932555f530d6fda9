"""Numbers that no scanner has, and that come of another unit: metres for millimetres, megahertz for hertz.

The bounds are a factor of five and more beyond what is built: arrays from intravascular (some 60 MHz, 0.05 mm
of pitch) to cardiac (1 MHz), depths of 0.3 m, 5 to 100 frames a second. Most values are inside them in one of
two units that are a thousand apart, and outside in the other.
"""

from __future__ import annotations

import numpy as np

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import RFSettings, Sweep

_BOUNDS = {
    "vector_pitch_mm": (0.005, 5.0, "mm"),
    "sample_spacing_mm": (0.0005, 5.0, "mm"),
    "first_sample_depth_mm": (-50.0, 400.0, "mm"),
    "depth_mm": (0.0, 1000.0, "mm"),
    "sampling_rate_hz": (2e5, 2e9, "Hz"),
    "centre_frequency_hz": (1e5, 3e8, "Hz"),
    "speed_of_sound_m_s": (300.0, 5000.0, "m/s"),
}
"""Lowest, highest, unit."""

_INTERVAL_S = (1e-4, 20.0)
"""Between frames: hands are imaged 5 to 100 times a second."""

_CENTRE = 1.5
"""How far the centre may lie outside the band, as a factor: transmit frequencies are written for it."""


def require_plausible(sweep: Sweep) -> None:
    """Refuse a sweep with a number that no scanner has.

    Raises
    ------
    InvalidInputError
        Naming the number, and that its unit may be another.
    """
    signal = sweep.signal
    for holder in (sweep.grid, signal):
        for name, (low, high, unit) in _BOUNDS.items():
            value = getattr(holder, name, None)
            if value is not None and not low <= value <= high:
                raise InvalidInputError(
                    f"{name}: expected {low:g} to {high:g} {unit}, got {value:g}: is it in another unit?"
                )
    if isinstance(signal, RFSettings):
        low_hz, high_hz = signal.bandwidth_hz
        if not low_hz / _CENTRE <= signal.centre_frequency_hz <= high_hz * _CENTRE:
            raise InvalidInputError(
                f"centre_frequency_hz: expected one near the band, {low_hz:g} to {high_hz:g} Hz, got "
                f"{signal.centre_frequency_hz:g}"
            )
    if len(sweep) > 1:
        interval_s = float(np.median(np.diff(sweep.frame_time_s)))
        if not _INTERVAL_S[0] <= interval_s <= _INTERVAL_S[1]:
            raise InvalidInputError(
                f"frame times: expected frames {_INTERVAL_S[0]:g} to {_INTERVAL_S[1]:g} s apart, got "
                f"{interval_s:g} s: are they in another unit? (--frame-rate-hz replaces them)"
            )
