"""Whether a log's gyroscope, accelerometer and own orientation tell of the same turning."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray
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
_WORDS = {"accelerometer": "across gravity ", "own orientation": ""}


class _Turning(NamedTuple):
    """Rate by the gyroscope and by the other, shape (n, 3), rad/s."""

    gyroscope: FloatArray
    other: FloatArray


def contradictions(log: ImuLog) -> dict[str, str]:
    """Sentences on what contradicts the gyroscope, by the other's name; empty where it agrees.

    What tells nothing, as an accelerometer of a sensor that turns about the vertical alone, is left out.
    """
    pairs = {"accelerometer": _by_gravity(log), "own orientation": _by_orientation(log)}
    return {name: _sentence(name, pair) for name, pair in pairs.items() if pair is not None and _tells(pair)}


def _tells(pair: _Turning) -> bool:
    return max(_rms(pair.gyroscope), _rms(pair.other)) > _TURNING_RAD_S


def _sentence(name: str, pair: _Turning) -> str:
    rate, shown = _rms(pair.gyroscope), _rms(pair.other)
    share = shown / max(rate, 1e-9)
    alike = float((pair.gyroscope * pair.other).mean()) / max(rate * shown / 3.0, 1e-12) > _ALIKE
    if rate > _TURNING_RAD_S and share < _FOLLOWED[0]:
        unit = "deg/s" if alike and share < 0.05 else "rad/s"
    elif alike and share > _FOLLOWED[1]:
        unit = "rad/s"
    else:
        return ""
    return (
        f"gyroscope and {name} contradict each other: {_WORDS[name]}the one turns by {rate:.2g} rad/s, the "
        f"other shows {100.0 * share:.3g} % of it: is the gyroscope in {unit}?"
    )


def _rms(vectors: FloatArray) -> float:
    return math.sqrt(float((vectors**2).sum(axis=1).mean()))


def _by_gravity(log: ImuLog) -> _Turning | None:
    """Seen from the sensor, gravity's direction u changes at the rate u x w.

    Short means near rest are compared. Movement makes the accelerometer show more turning, never less, except
    that of a free pendulum.
    """
    force, rate = log.accelerometer_m_s2, log.gyroscope_rad_s
    if force is None or rate is None:
        return None
    means = _means(log, np.asarray(np.isfinite(force).all(axis=1)), rate, force)
    if means is None:
        return None
    time_s, rate, force = means
    norm = np.linalg.norm(force, axis=1)
    up, step = force / np.maximum(norm, 1e-9)[:, None], np.diff(time_s)
    calm = np.abs(norm / np.median(norm) - 1.0) < _CALM
    calm = calm[1:] & calm[:-1] & (step < 2.0 * np.median(step))
    if calm.sum() < _FEWEST:
        return None
    across = np.cross(up[1:] + up[:-1], rate[1:] + rate[:-1])[calm] / 4.0
    return _Turning(across, np.diff(up, axis=0)[calm] / step[calm, None])


def _by_orientation(log: ImuLog) -> _Turning | None:
    """The own orientation's turn from one sample to another a tenth of a second later."""
    rate, own = log.gyroscope_rad_s, log.world_from_sensor
    if rate is None or own is None:
        return None
    means = _means(log, log.oriented, rate, np.arange(len(log))[:, None].astype(float))
    if means is None:
        return None
    _, rate, middle = means
    at = np.rint(middle[:, 0]).astype(int)
    step = np.diff(log.time_s[at])
    near = step < 2.0 * np.median(step)
    if near.sum() < _FEWEST:
        return None
    turn = (own[at[:-1]].inv() * own[at[1:]]).as_rotvec() / step[:, None]
    return _Turning((0.5 * (rate[1:] + rate[:-1]))[near], turn[near])


def _means(log: ImuLog, there: BoolArray, rate: FloatArray, other: FloatArray) -> list[FloatArray] | None:
    """Means of time, rate and another quantity over a tenth of a second; None of too few."""
    at = np.flatnonzero(there & np.isfinite(rate).all(axis=1))
    if at.size < 2:
        return None
    width = max(1, round(_COMPARED_S / float(np.median(np.diff(log.time_s[at])))))
    count = at.size // width
    if count <= _FEWEST:
        return None
    at = at[: count * width]
    columns = (log.time_s[at, None], rate[at], other[at])
    means = [column.reshape(count, width, -1).mean(axis=1) for column in columns]
    return [means[0][:, 0], *means[1:]]
