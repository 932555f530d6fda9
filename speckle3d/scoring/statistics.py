"""Confidence intervals of means over sweeps, and paired comparisons of two modes.

A sweep is the unit: one number per sweep and mode. With fewer than `FEWEST` sweeps, or without any scatter,
no interval is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

FEWEST = 3
"""Sweeps that an interval needs: below, a bootstrap only repeats the values themselves."""

_SEED = 20081


def mean_interval(values: npt.ArrayLike) -> dict[str, Any]:
    """``sweeps``, their ``mean``, and ``low`` and ``high`` end of its 95 % interval, in the values' unit.

    By a percentile bootstrap [1]_, seeded, so that it repeats; None where sweeps are too few or all alike.

    References
    ----------
    .. [1] B. Efron and R. J. Tibshirani, "An Introduction to the Bootstrap", 1993, chapter 13.
    """
    sample, low, high = np.asarray(values, dtype=float), None, None
    if sample.size >= FEWEST and np.ptp(sample) > 0:
        from scipy import stats  # half a second, which one sweep has no need of

        bootstrap = stats.bootstrap((sample,), np.mean, method="percentile", rng=_SEED)
        low, high = map(float, bootstrap.confidence_interval)
    return {"sweeps": sample.size, "mean": float(sample.mean()), "low": low, "high": high}


def signed_rank_p(differences: npt.ArrayLike) -> float | None:
    """Wilcoxon's two-sided signed-rank test of differences, sweep by sweep, of two modes.

    None where they are too few or all alike. With n sweeps it cannot be below 2 / 2**n, so that five sweeps
    never reach 0.05.
    """
    sample = np.asarray(differences, dtype=float)
    if sample.size < FEWEST or not np.ptp(sample) > 0:
        return None
    from scipy import stats

    return float(stats.wilcoxon(sample).pvalue)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Correct p values of several tests for their number [1]_; None stands for a test that was not made.

    SciPy 1.18 corrects for false discoveries (Benjamini and Hochberg) but not for any error at all (Holm).

    References
    ----------
    .. [1] S. Holm, "A simple sequentially rejective multiple test procedure", Scand. J. Statist. 6, 1979.
    """
    tests = [p for p in p_values if p is not None]
    order = np.argsort(tests)
    products = np.sort(tests) * np.arange(len(tests), 0, -1)
    holm_p = np.minimum(np.maximum.accumulate(products), 1.0)[np.argsort(order)].tolist()
    return [None if p is None else holm_p.pop(0) for p in p_values]
