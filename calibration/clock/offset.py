"""A sensor's clock offset: the result, which frames have readings, and the search for the best delay."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np
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
    # Steps too small to miss a gap.
    steps = np.linspace(-slack_s, slack_s, 1 + ceil(2.0 * slack_s / readings.max_gap_s))
    return np.asarray(np.all([readings.covers(frame_time_s - offset_s - step) for step in steps], axis=0))


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
