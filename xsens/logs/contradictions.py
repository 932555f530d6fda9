"""Whether a log's gyroscope, accelerometer and own orientation tell of the same turning."""

from __future__ import annotations

import math

import numpy as np

from speckle3d.core.arrays import FloatArray
from xsens.logs.samples import ImuLog

_COMPARED_S = 0.1
"""Interval over which turns are compared: a hand turns by less than a radian in it."""

_MOVING_RAD_S = 0.2
"""Smallest RMS rate that is compared: eleven degrees per second, beyond any bias."""

_TURNING_RAD_S = 0.5
"""RMS rate from which a gyroscope must be followed: below it movement hides it."""

_HONEST_SHARES = (0.7, 1.6)
"""Share of the gyroscope's turn, axis by axis, that the other must show: 1 if all is right, 1/57 if the unit
is deg/s, another if the rate of samples is, -1 or about 0 if axes are exchanged. BROAD's trials and simulated
hands show 0.85 to 1.09; rocking once a second about a point 0.07 m above
the sensor shows 0.7, 0.12 m below it 1.5."""

_ALIKE, _TIMES_LARGER = 0.9, 3.0
"""Correlation from which so many times the gyroscope's turn is another unit, not the hand's acceleration."""

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
        if rates is not None and max(map(_rms, rates)) > _MOVING_RAD_S:
            sentences[name] = _sentence(name, *rates)
    return sentences


def _sentence(name: str, gyroscope: FloatArray, reference: FloatArray) -> str:
    rate, reference_rate = _rms(gyroscope), _rms(reference)
    common = float((gyroscope * reference).sum(axis=1).mean())
    share = common / max(rate, 1e-9) ** 2
    if rate > _TURNING_RAD_S and not _HONEST_SHARES[0] < share < _HONEST_SHARES[1]:
        doubt = "in deg/s" if 0.0 < share < 0.05 else "as it is told, in rate, axes and signs"
    elif common > _ALIKE * rate * reference_rate and reference_rate > _TIMES_LARGER * rate:
        doubt = "in rad/s"
    else:
        return ""
    return (
        f"gyroscope and {name} contradict each other: the one turns by {rate:.2g} rad/s, the other shows "
        f"{100.0 * share:.3g} % of it: is the gyroscope {doubt}?"
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
    columns = columns[np.isfinite(columns.sum(axis=1))]
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
