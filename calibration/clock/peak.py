"""The best of the delays that were tried on images: whether it stands out, and where exactly it lies.

Noise has a best delay too. So each image is asked for itself, and most must say the same.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calibration.clock.offset import require_peak
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError

STEP_S = 0.01

LEAST_AGREEING = 0.5
"""Share of the compared images that must fit best, each for itself, near the common best delay: how strong
speckle and noise are does not matter. Of simulated tissue it is 0.7 to 1, 0.56 at worst under noise twice as
strong as the picture; of noise, images in another order, ones that never change or delays outside the range
it is up to 0.44; where it was more, of images reversed in time and ones 1.2 s late, no top was placed."""

LEAST_CORRELATION = 0.1
"""Of images with their reslices, on average at the best delay: the best of a hundred delays reaches 0.06 with
noise as smooth as speckle, and 0.23 with tissue under noise twice as strong as the picture."""

Likeness = Callable[[float], FloatArray]
"""Correlations of the queries at a delay, NaN where a query has no support."""

SIGMAS = 3.0
_WIDEST_S = 0.1
_BLOCK = 5
_RESAMPLES = 200


def mean_of(correlations: FloatArray) -> float:
    """Mean over the queries; zero where fewer than half have support."""
    held = np.isfinite(correlations)
    return float(correlations[held].mean()) if 2 * held.sum() >= max(correlations.size, 1) else 0.0


def curves_at(
    likeness: Likeness, tried_s: FloatArray, progress: Callable[[int, int], None] | None
) -> tuple[FloatArray, FloatArray]:
    """Delays at which enough queries have support, and their correlations there, shape (k, queries)."""
    rows = []
    for number, delay in enumerate(tried_s):
        rows.append(likeness(float(delay)))
        if progress is not None:
            progress(number + 1, len(tried_s))
    curves = np.array(rows)
    held = 2 * np.isfinite(curves).sum(axis=1) >= max(curves.shape[1], 1)
    if not held.any():
        raise InsufficientDataError("expected images of the two ways that meet, got none at any delay")
    return tried_s[held], curves[held]


def clear_peak(tried_s: FloatArray, curves: FloatArray, misfit: FloatArray, search_s: float) -> int:
    """Index of the best delay.

    Raises
    ------
    InsufficientDataError
        If it lies at the range's end, images hardly correlate there, it has a rival, or most images have
        another.
    """
    best = int(np.argmin(misfit))
    beside = tried_s[max(best - 1, 0) : best + 2]
    # Farther out too few images may have support: that is an end of the range too.
    if beside.size < 3 or np.ptp(beside) > 3.0 * STEP_S:
        raise InsufficientDataError(
            f"expected a delay inside the {search_s:g} s searched either way, got {tried_s[best]:+.3f} s, at "
            f"the range's end: the delay may lie outside the {search_s:g} s searched: --search-s"
        )
    if 1.0 - misfit[best] < LEAST_CORRELATION:
        raise InsufficientDataError(
            f"expected images of the two ways that correlate by {LEAST_CORRELATION:g} or more at some delay, "
            f"got {1.0 - misfit[best]:.2f} at best: {doubts(search_s)}"
        )
    require_peak(tried_s, misfit, best, f"the motion repeats itself, or {doubts(search_s)}")
    near = np.abs(tried_s - tried_s[best]) < half_width(tried_s, misfit, best) + 0.5 * STEP_S
    there = curves[:, np.isfinite(curves[best])]
    agree, count, chance = int(near[np.nanargmax(there, axis=0)].sum()), there.shape[1], float(near.mean())
    luck = min(1.0, chance + SIGMAS * np.sqrt(chance * (1.0 - chance) / count))
    if agree < max(LEAST_AGREEING, luck) * count:
        raise InsufficientDataError(
            "expected images that show where they were taken, got only "
            f"{agree} of {count} that fit best near {tried_s[best]:+.3f} s, the best delay of all: "
            f"{doubts(search_s)}"
        )
    return best


def doubts(search_s: float) -> str:
    """What may be wrong where no delay is better than chance."""
    return (
        "images and readings do not belong together, or the delay lies outside the "
        f"{search_s:g} s searched: --search-s"
    )


def half_width(tried_s: FloatArray, misfit: FloatArray, best: int) -> float:
    """How far from the best delay half of what it gains over the others is lost."""
    half = 0.5 * (misfit[best] + float(np.median(misfit)))
    above = np.flatnonzero(misfit > half)
    nearest = float(np.abs(tried_s[above] - tried_s[best]).min()) if above.size else _WIDEST_S
    return min(max(nearest, 2.0 * STEP_S), _WIDEST_S)


def placed(likeness: Likeness, near_s: FloatArray) -> tuple[float, float]:
    """Top of a parabola through the mean likeness near the peak, and its scatter over runs of queries.

    The top alone ripples with the frames that happen to be there. Runs, since neighbours share frames of
    the other way.
    """
    curves = np.array([likeness(float(each)) for each in near_s])
    curves = curves[:, np.isfinite(curves).all(axis=0)]
    middle = float(near_s.mean())
    runs = curves.shape[1] // _BLOCK
    if runs < 2:
        return middle, float("inf")
    means = curves[:, : runs * _BLOCK].reshape(len(near_s), runs, _BLOCK).mean(axis=2)
    second, first = np.polyfit(near_s - middle, means, 2)[:2]
    drawn = np.random.default_rng(0).integers(0, runs, (_RESAMPLES, runs))
    if not second.mean() < 0:
        return middle, float("inf")
    scatter = np.std(-first[drawn].mean(axis=1) / (2.0 * second[drawn].mean(axis=1)))
    return middle - float(first.mean() / (2.0 * second.mean())), float(scatter)
