"""Curves corrected by sweeps whose length another source than the images knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.curves import TISSUE_SIGMA, DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError
from speckle3d.motion.curve_prior import RowsSeen, learn_correction
from speckle3d.motion.diffraction import half_distance

ANY_COMMON = 0.2
"""Standard deviation of what all distances may be wrong by alike, beside what another lens does: the lengths
that are known shall decide it."""


class Read(Protocol):
    """A sweep that was read with curves, such as `speckle3d.pipeline.Tracked`."""

    @property
    def curves(self) -> DecorrelationCurves:
        """With which it was read."""

    @property
    def rows(self) -> RowsSeen:
        """Distances that its rows of patches still want, over those of all."""


def corrected_curves(
    curves: DecorrelationCurves,
    tracked: Sequence[Read],
    log_scale: Sequence[float],
    log_scale_sigma: Sequence[float],
) -> DecorrelationCurves:
    """Correct the curves of a probe by sweeps made with it whose true length is known.

    Parameters
    ----------
    curves : DecorrelationCurves
        That the sweeps were read with, as given to `speckle3d.pipeline.track`.
    tracked : sequence of Read
        The sweeps, each as `speckle3d.pipeline.track` has it.
    log_scale, log_scale_sigma : sequence of float
        Of each sweep: the logarithm of its true elevational length over the images', from a crossing sweep,
        or a tracker, and its standard deviation.

    Factors by depth follow what another lens does; what all depths have in common follows the lengths known.
    Tissue whose structure reads short is corrected with it: curves learnt over tissue are right over tissue.

    Returns
    -------
    DecorrelationCurves
        Of origin "crossing"; their `scale_sigma` is that of the correction and of other tissue.

    Raises
    ------
    InsufficientDataError
        If there is no sweep, or none whose length is known.
    """
    scale, sigma = np.asarray(log_scale, dtype=float), np.asarray(log_scale_sigma, dtype=float)
    if not len(tracked) == scale.size == sigma.size or not scale.size:
        raise InsufficientDataError(
            f"corrected curves: expected sweeps with a log scale and its deviation each, got {len(tracked)} "
            f"sweeps, {scale.size} scales and {sigma.size} deviations"
        )
    if not (np.isfinite(scale).all() and np.isfinite(sigma).all() and (sigma > 0).all()):
        raise InsufficientDataError(
            "corrected curves: expected finite log scales with deviations above zero, got others"
        )
    seen = [
        replace(
            each.rows,
            logarithm=each.rows.logarithm - _widened(each.curves, curves, each.rows.depth_mm),
            log_scale=float(true),
            log_scale_sigma=float(deviation),
        )
        for each, true, deviation in zip(tracked, scale, sigma, strict=True)
    ]
    found = learn_correction(curves, seen, ANY_COMMON)
    return replace(
        found.applied(curves), scale_sigma=float(np.hypot(found.sigma, TISSUE_SIGMA)), origin="crossing"
    )


def _widened(used: DecorrelationCurves, given: DecorrelationCurves, depth_mm: FloatArray) -> FloatArray:
    """Logarithm of the distances of one set of curves over another's, at some depths."""
    wide, narrow = (
        [half_distance(each.distance_mm, row) for row in each.at(depth_mm).correlation]
        for each in (used, given)
    )
    return np.asarray(np.log(wide) - np.log(narrow))
