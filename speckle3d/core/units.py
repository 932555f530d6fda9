"""Units, told by the end of a name."""

from __future__ import annotations

_UNITS = {
    "_mm": "mm",
    "_rad": "rad",
    "_deg": "degrees",
    "_s": "s",
    "_hz": "Hz",
    "_db": "dB",
    "_gb": "GB",
    "_m_s": "m/s",
    "_m_s2": "m/s^2",
    "_deg_s": "degrees/s",
    "_rad_s": "rad/s",
    "_deg_per_mm": "degrees/mm",
}


def unit_of(name: str) -> str:
    """Unit of a quantity that carries it at the end of its name; empty for a pure number.

    Examples
    --------
    >>> unit_of("voxel_mm"), unit_of("speed_of_sound_m_s"), unit_of("frames")
    ('mm', 'm/s', '')
    """
    fits = [end for end in _UNITS if name.endswith(end)]
    return _UNITS[max(fits, key=len)] if fits else ""
