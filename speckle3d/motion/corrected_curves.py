"""Curves corrected by sweeps whose length another source than the images knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from speckle3d.core.curves import TISSUE_SIGMA, DecorrelationCurves, TiltResponse
from speckle3d.core.errors import InsufficientDataError


class Read(Protocol):
    """A sweep that was read with curves, such as `speckle3d.pipeline.Tracked`."""

    @property
    def scale_sigma(self) -> float:
        """Relative standard deviation of the scale of its distances."""


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
        That the sweeps were read with.
    tracked : sequence of Read
        The sweeps, each as `speckle3d.pipeline.track` has it.
    log_scale, log_scale_sigma : sequence of float
        Of each sweep: the logarithm of its true elevational length over the images', from a crossing sweep,
        an inertial sensor or a tracker, and its standard deviation.

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
    weight = 1.0 / sigma**2
    factor = float(np.exp(np.average(scale, weights=weight)))
    tilt = curves.tilt and TiltResponse(factor * curves.tilt.pivot_mm, factor**2 * curves.tilt.spread_mm)
    return replace(
        curves,
        distance_mm=factor * curves.distance_mm,
        tilt=tilt,
        scale_sigma=float(np.hypot(weight.sum() ** -0.5, TISSUE_SIGMA)),
        origin="crossing",
    )
