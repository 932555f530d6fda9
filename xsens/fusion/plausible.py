"""Whether readings can be what they are said to be: units, a field that is there, gravity that follows."""

from __future__ import annotations

import math

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.fusion.settings import BRIDGED_S

FORCE_M_S2 = (4.0, 25.0)
"""Between which the median of the accelerometer's norm lies if it is in m/s^2."""

FASTEST_RAD_S = 60.0
"""The widest range of the sensors' gyroscopes ends at 35 rad/s about an axis; sixty degrees per second are an
ordinary movement of a hand."""

UNKNOWN_HEADING_RAD = math.radians(45.0)
"""A heading whose standard deviation is larger tells no direction."""

_COMPARED_S = 0.1
"""Gravity is followed over so long: a hand turns by less than a radian in it."""

_TURNING_RAD_S = 0.2
"""RMS rate across gravity from which the two are compared: eleven degrees per second, beyond any bias."""

_FOLLOWED = 0.3
"""Of the gyroscope's turn gravity shows 1 in rad/s, 1/57 in deg/s, 0 if they do not belong together."""

_NEAR_REST_M_S2 = 1.0
_FEWEST = 20


def require_rising_in_seconds(steps_s: FloatArray, source: str) -> None:
    """Refuse a clock too slow to integrate a gyroscope by; raises `InvalidInputError`."""
    median = float(np.median(steps_s))
    if median > BRIDGED_S * (1.0 + 1e-6):
        raise InvalidInputError(
            f"{source}: expected samples at most {BRIDGED_S:g} s apart, got a median of {median:.4g} s: "
            "times in milliseconds?"
        )


def require_metres(force_m_s2: FloatArray, source: str) -> None:
    """Refuse an accelerometer, shape (m, 3), that is not in m/s^2; raises `InvalidInputError`."""
    median = float(np.median(np.linalg.norm(force_m_s2, axis=1)))
    low, high = FORCE_M_S2
    if not low < median < high:
        raise InvalidInputError(
            f"{source}: expected an accelerometer in m/s^2, with norm near 9.8, got a median of {median:.3g}"
        )


def require_radians(rate_rad_s: FloatArray, source: str) -> None:
    """Refuse a gyroscope, shape (m, 3), of which one reading in a hundred is beyond any sensor."""
    fast = float(np.percentile(np.linalg.norm(rate_rad_s, axis=1), 99.0))
    if fast > FASTEST_RAD_S:
        raise InvalidInputError(
            f"{source}: expected a gyroscope in rad/s, got one in a hundred over {fast:.3g}: in deg/s?"
        )


def real_field(field_au: FloatArray) -> tuple[FloatArray, int]:
    """The field, shape (m, 3), NaN where it is none, and how many readings were exactly zero."""
    zero = (field_au == 0.0).all(axis=1)
    none = zero | ~np.isfinite(field_au).all(axis=1)
    return np.where(none[:, None], np.nan, field_au), int(zero.sum())


def contradiction(time_s: FloatArray, rate_rad_s: FloatArray, force_m_s2: FloatArray) -> str | None:
    """A note if gravity does not turn as the gyroscope says, None if it does or nothing can be told.

    Seen from the sensor gravity's direction u changes by u x w. Compared are the RMS of both over short means
    near rest only; movement makes the accelerometer show more, never less, but for a free pendulum's.
    """
    width = max(1, round(_COMPARED_S / float(np.median(np.diff(time_s)))))
    count = len(time_s) // width
    if count <= _FEWEST:
        return None
    rate, force = (a[: count * width].reshape(count, width, 3).mean(axis=1) for a in (rate_rad_s, force_m_s2))
    middle = time_s[: count * width].reshape(count, width).mean(axis=1)
    norm = np.linalg.norm(force, axis=1)
    up = force / np.maximum(norm, 1e-9)[:, None]
    step = np.diff(middle)
    calm = np.abs(norm - np.median(norm)) < _NEAR_REST_M_S2
    calm = calm[1:] & calm[:-1] & (step < 2.0 * np.median(step))
    if calm.sum() < _FEWEST:
        return None
    across = np.cross(up[1:] + up[:-1], rate[1:] + rate[:-1])[calm] / 4.0
    shown = np.diff(up, axis=0)[calm] / step[calm, None]
    square = float(np.mean((across**2).sum(axis=1)))
    share = math.sqrt(float(np.mean((shown**2).sum(axis=1))) / max(square, 1e-12))
    if square < _TURNING_RAD_S**2 or share > _FOLLOWED:
        return None
    return (
        f"gyroscope and accelerometer contradict each other: across gravity the one turns by "
        f"{math.sqrt(square):.2g} rad/s, the other shows {100.0 * share:.0f} % of it: gyroscope in rad/s?"
    )
