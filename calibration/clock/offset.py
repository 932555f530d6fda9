"""A sensor's clock offset: the result, which frames have readings, and the search for the best delay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import find_peaks

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.streams import TimedPoses, TimedRotations

SEARCH_S = 0.5
"""How far to either side of the known delay others are tried."""

_AMBIGUOUS = 0.1
"""Another delay counts as a rival if it is worse by less than this share of what the best delay gains."""


@dataclass(frozen=True)
class ClockOffset:
    """A sensor's clock offset: a reading at t belongs to image time t + `seconds`.

    Attributes
    ----------
    standard_error_s : float
    followed : float
        How well images and sensor agree at this offset: the share of a line's variance that the sensor's
        motion explains, or the mean correlation of images with reslices. NaN where neither was measured.
    """

    seconds: float
    standard_error_s: float
    followed: float = float("nan")


def covered(
    readings: TimedPoses | TimedRotations, frame_time_s: FloatArray, offset_s: float, slack_s: float = 0.0
) -> BoolArray:
    """Mask of frames with a reading, for any offset within `slack_s` of `offset_s`."""
    times, sample_s = np.asarray(frame_time_s) - offset_s, readings.time_s
    inside = (times - slack_s >= sample_s[0]) & (times + slack_s <= sample_s[-1])
    gaps = np.flatnonzero(np.diff(sample_s) > readings.max_gap_s)
    first, last = times[:, None] - slack_s, times[:, None] + slack_s
    in_gap = (last > sample_s[gaps]) & (first < sample_s[gaps + 1])
    return np.asarray(inside & ~in_gap.any(axis=1))


def delays_around(around_s: float, search_s: float, step_s: float) -> FloatArray:
    """Delays from `around_s` - `search_s` to `around_s` + `search_s`, a step apart."""
    steps = np.arange(-round(search_s / step_s), round(search_s / step_s) + 1)
    return np.asarray(around_s + steps * step_s, dtype=np.float64)


def peak_of(tried_s: FloatArray, misfit: FloatArray, doubt: str) -> int:
    """Index of the delay of least misfit.

    Parameters
    ----------
    doubt : str
        Likely reason of a rival, for the message.

    Raises
    ------
    InsufficientDataError
        If it lies at the end of the range, or another is nearly as good.
    """
    best = int(np.argmin(misfit))
    if best in (0, len(tried_s) - 1):
        raise InsufficientDataError(
            f"expected a delay between {tried_s[0]:g} and {tried_s[-1]:g} s, got the best at the range's "
            "end: the delay may lie outside the range searched: --search-s"
        )
    gain = float(np.median(misfit) - misfit[best])
    good = find_peaks(-misfit, height=-(misfit[best] + _AMBIGUOUS * gain))[0]
    # Not by find_peaks' prominence: the range may end before the misfit rises beyond a rival.
    for rival in good[good != best]:
        if misfit[min(rival, best) : max(rival, best)].max() - misfit[best] > 0.5 * gain:
            pair = f"{tried_s[best]:+.3f} and {tried_s[rival]:+.3f} s"
            raise InsufficientDataError(f"expected one delay, got {pair} nearly as good: {doubt}")
    return best


def least_between(
    cost: Callable[[float], float], tried_s: FloatArray, best: int
) -> tuple[float, float, float]:
    """Delay of least cost between the neighbours of the best one tried, that cost, and its curvature."""
    low, middle, high = tried_s[best - 1 : best + 2]
    fit = minimize_scalar(
        lambda delay: cost(float(delay)), bounds=(low, high), method="bounded", options={"xatol": 1e-5}
    )
    seconds, least, step = float(fit.x), float(fit.fun), float(high - middle)
    return seconds, least, (cost(seconds - step) - 2.0 * least + cost(seconds + step)) / step**2
