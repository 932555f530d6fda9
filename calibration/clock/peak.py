"""The best of the delays tried on images: whether it stands out from chance, and where exactly it lies.

Even noise has a minimum, so each image votes with its own best delay, and most must agree.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calibration.clock.offset import require_peak
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError

STEP_S = 0.01

LEAST_AGREEING = 0.5
"""Share of the compared images whose own best delay must be near the common one; the strength of speckle and
noise does not enter. It is 0.7 to 1 for simulated tissue and at least 0.56 under noise twice as strong as the
picture; up to 0.44 for noise, shuffled images, ones that never change and delays outside the range. It was
more for images reversed in time and ones 1.2 s late, in which no peak could be located."""

LEAST_CORRELATION = 0.1
"""Least mean correlation of images with their reslices at the best delay. The best of a hundred delays
reaches 0.06 for noise as smooth as speckle, and 0.23 for tissue under noise of twice its strength."""

Correlations = Callable[[float], FloatArray]
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
    correlations: Correlations, tried_s: FloatArray, progress: Callable[[int, int], None] | None
) -> tuple[FloatArray, FloatArray]:
    """Delays at which enough queries have support, and their correlations there, shape (k, queries)."""
    rows = []
    for number, delay in enumerate(tried_s):
        rows.append(correlations(float(delay)))
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
    # Delays without enough supported images were dropped, so the range may also end within the one tried.
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
    """Likely causes where no delay is better than chance, for messages."""
    return (
        "images and readings do not belong together, or the delay lies outside the "
        f"{search_s:g} s searched: --search-s"
    )


def half_width(tried_s: FloatArray, misfit: FloatArray, best: int) -> float:
    """Distance from the best delay at which half of its gain over the median is lost."""
    half = 0.5 * (misfit[best] + float(np.median(misfit)))
    above = np.flatnonzero(misfit > half)
    nearest = float(np.abs(tried_s[above] - tried_s[best]).min()) if above.size else _WIDEST_S
    return min(max(nearest, 2.0 * STEP_S), _WIDEST_S)


def placed(correlations: Correlations, near_s: FloatArray) -> tuple[float, float]:
    """Vertex of a parabola through the mean correlations near the peak, and its bootstrap standard error.

    A parabola, since the maximum itself ripples with the frames that happen to be there. Runs of queries are
    resampled, since neighbours share frames of the other way.
    """
    curves = np.array([correlations(float(each)) for each in near_s])
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
