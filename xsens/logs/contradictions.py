"""Whether a log's gyroscope, accelerometer and own orientation tell of the same turning."""

from __future__ import annotations

import math

import numpy as np

from speckle3d.core.arrays import FloatArray
from xsens.logs.samples import ImuLog

_COMPARED_S = 0.1
"""Interval over which turns are compared: a hand turns by less than a radian in it."""

_TURNING_RAD_S = 0.2
"""Smallest RMS rate that is compared: eleven degrees per second, beyond any bias."""

_FOLLOWED = (0.3, 3.0)
"""Share of the gyroscope's turn that the other must show: 1 if the unit is rad/s, 1/57 if it is deg/s, 57 if
degrees were converted twice, about 0 if the two do not belong together."""

_ALIKE = 0.9
"""Correlation from which more turning than the gyroscope's is another unit, not the hand's acceleration."""

_CALM = 0.1
"""Share of its median by which the acceleration's length may differ where it shows gravity."""

_FEWEST = 20


def contradictions(log: ImuLog) -> dict[str, str]:
    """Sentences on what contradicts the gyroscope, by the other's name; empty where it agrees.

    What tells nothing, as an accelerometer of a sensor that turns about the vertical alone, is left out.
    """
    directions = {"accelerometer": log.accelerometer_m_s2, "own orientation": log.own_direction}
    sentences = {}
    for name, direction in directions.items():
        rates = None if direction is None else _rates_across(log, direction)
        if rates is not None and max(map(_rms, rates)) > _TURNING_RAD_S:
            sentences[name] = _sentence(name, *rates)
    return sentences


def _sentence(name: str, gyroscope: FloatArray, other: FloatArray) -> str:
    rate, shown = _rms(gyroscope), _rms(other)
    share = shown / max(rate, 1e-9)
    alike = float((gyroscope * other).mean()) / max(rate * shown / 3.0, 1e-12) > _ALIKE
    if rate > _TURNING_RAD_S and share < _FOLLOWED[0]:
        unit = "deg/s" if alike and share < 0.05 else "rad/s"
    elif alike and share > _FOLLOWED[1]:
        unit = "rad/s"
    else:
        return ""
    return (
        f"gyroscope and {name} contradict each other: the one turns by {rate:.2g} rad/s, the other shows "
        f"{100.0 * share:.3g} % of it: is the gyroscope in {unit}?"
    )


def _rms(vectors: FloatArray) -> float:
    return math.sqrt(float((vectors**2).sum(axis=1).mean()))


def _rates_across(log: ImuLog, direction: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Rate of a direction that rests in the world, seen from the sensor, by the gyroscope and as it is read.

    A direction u changes at the rate u x w. Short means near rest are compared: movement makes the
    accelerometer show more turning, never less, except that of a free pendulum. None of too few samples.
    """
    if log.gyroscope_rad_s is None:
        return None
    columns = np.column_stack([log.time_s, log.gyroscope_rad_s, direction])
    columns = columns[np.isfinite(columns).all(axis=1)]
    if len(columns) <= _FEWEST:
        return None
    width = max(1, round(_COMPARED_S / float(np.median(np.diff(columns[:, 0])))))
    count = len(columns) // width
    means = columns[: count * width].reshape(count, width, 7).mean(axis=1)
    if count <= _FEWEST:
        return None
    rate, norm, step = means[:, 1:4], np.linalg.norm(means[:, 4:], axis=1), np.diff(means[:, 0])
    u = means[:, 4:] / np.maximum(norm, 1e-9)[:, None]
    calm = np.abs(norm / np.median(norm) - 1.0) < _CALM
    calm = calm[1:] & calm[:-1] & (step < 2.0 * np.median(step))
    if calm.sum() < _FEWEST:
        return None
    across = np.cross(u[1:] + u[:-1], rate[1:] + rate[:-1])[calm] / 4.0
    return across, np.diff(u, axis=0)[calm] / step[calm, None]
