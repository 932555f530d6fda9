"""Confidence intervals of means over sweeps, and paired comparisons of two modes.

A sweep is the unit: one number per sweep and mode. With fewer than `FEWEST` sweeps, or without any scatter,
no interval is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, MismatchError

FEWEST = 3
"""Sweeps that an interval needs: below, a bootstrap only repeats the values themselves."""

_RESAMPLES = 9999
_SEED = 20081


@dataclass(frozen=True)
class MeanInterval:
    """Mean over sweeps and its bootstrap interval, in the unit of the values.

    `low` and `high` are None where the sweeps are too few or all alike.
    """

    sweeps: int
    mean: float
    low: float | None
    high: float | None


def mean_interval(values: npt.ArrayLike) -> MeanInterval:
    """Mean of one value per sweep, with its 95 % percentile bootstrap interval [1]_; seeded, so it repeats.

    NaN stands for a sweep without a value and is left out.

    Raises
    ------
    InsufficientDataError
        If no sweep has a value.

    References
    ----------
    .. [1] B. Efron and R. J. Tibshirani, "An Introduction to the Bootstrap", 1993, chapter 13.
    """
    held = _present(np.asarray(values, dtype=float))
    mean = float(held.mean())
    if not _scatters(held):
        return MeanInterval(held.size, mean, None, None)
    from scipy import stats  # takes 0.3 s to import, which a single reconstruction does without

    interval = stats.bootstrap(
        (held,),
        np.mean,
        n_resamples=_RESAMPLES,
        confidence_level=0.95,
        method="percentile",
        rng=np.random.default_rng(_SEED),
    ).confidence_interval
    return MeanInterval(held.size, mean, float(interval.low), float(interval.high))


def paired_comparison(first: npt.ArrayLike, second: npt.ArrayLike) -> tuple[MeanInterval, float | None]:
    """Compare two modes by their differences, sweep by sweep; sweeps that lack either are left out.

    Returns
    -------
    difference : MeanInterval
        Of the first mode's values less the second's.
    wilcoxon_p : float or None
        Two-sided signed-rank test; None where `difference` has no interval. With n sweeps it cannot be below
        2 / 2**n, so that five sweeps never reach 0.05.

    Raises
    ------
    MismatchError
        If the two are not of the same sweeps.
    InsufficientDataError
        If no sweep has both values.
    """
    one, other = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    if one.shape != other.shape:
        raise MismatchError(f"second mode: expected values of shape {one.shape}, got {other.shape}")
    differences = _present(one - other)
    found = mean_interval(differences)
    if not _scatters(differences):
        return found, None
    from scipy import stats

    return found, float(stats.wilcoxon(differences).pvalue)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Correct p values of several tests for their number [1]_; None stands for a test that was not made.

    SciPy 1.18 corrects for false discoveries (Benjamini and Hochberg) but not for any error at all (Holm).

    References
    ----------
    .. [1] S. Holm, "A simple sequentially rejective multiple test procedure", Scand. J. Statist. 6, 1979.
    """
    made = sorted((p, i) for i, p in enumerate(p_values) if p is not None)
    corrected: list[float | None] = [None] * len(p_values)
    least = 0.0
    for rank, (p, i) in enumerate(made):
        least = max(least, min(1.0, (len(made) - rank) * p))
        corrected[i] = least
    return corrected


def _present(values: FloatArray) -> FloatArray:
    held: FloatArray = values[np.isfinite(values)]
    if not held.size:
        raise InsufficientDataError("statistics over sweeps: expected at least one value, got none")
    return held


def _scatters(values: FloatArray) -> bool:
    return values.size >= FEWEST and bool(np.ptp(values) > 0)
