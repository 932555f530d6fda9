"""First strong echo in each column: found by the slope of smoothed grey levels, placed at front or peak."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.detection.region import Columns
from calibration.settings import Place
from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.kernels.lines import echo_fronts, echo_levels, filter_columns, first_edges

_FINE = 0.25
"""Smoothing for placing an echo, as a share of that for finding it: enough against noise, little against
the rise of an echo."""
_REACH = 3.5
"""Length of the filters' sides, standard deviations."""
_AHEAD = 2.0
"""Farthest that an echo is brightest below its edge, standard deviations; its length is 1.5 of them."""
_LEAST = 0.3
"""Least slope of an edge, as a share of the median of the columns' steepest slopes."""


@dataclass(frozen=True)
class Profiles:
    """Smoothed grey levels and slopes along columns of an image.

    Attributes
    ----------
    columns : Columns
    levels : ndarray, shape (n, r)
        The image, slightly smoothed.
    slope : ndarray, shape (n, r)
        How steeply the image, strongly smoothed, rises, levels per row.
    sigma : float
        Of the strong smoothing, rows.
    """

    columns: Columns
    levels: Float32Array
    slope: Float32Array
    sigma: float

    def brightness(self) -> Float32Array:
        """Brightness of the echo that begins at each edge, above the image's median level; 0 elsewhere."""
        bright = np.empty_like(self.levels)
        least = _LEAST * typical(self.slope, self.columns)
        dark = float(np.median(self.levels[self.columns.inside]))
        ahead = int(np.ceil(_AHEAD * self.sigma))
        echo_levels(self.slope, self.levels, self.columns.spans, least, dark, ahead, bright)
        return bright


@dataclass(frozen=True)
class Edges:
    """One edge in each column.

    Attributes
    ----------
    row : ndarray, shape (n,)
        Where the echo is; NaN without one.
    strength : ndarray, shape (n,)
        Its score; 0 without one.
    """

    row: FloatArray
    strength: FloatArray


def typical(score: Float32Array, columns: Columns) -> float:
    """Median of the columns' largest scores."""
    return float(np.median(score[columns.inside.any(axis=1)].max(axis=1)))


def take_profiles(samples: Float32Array, columns: Columns, sigma: float) -> Profiles:
    """Smooth columns by Gaussians and differentiate them, within the region.

    Parameters
    ----------
    samples : ndarray, shape (n, r)
    sigma : float
        Of the smoothing with which edges are found, rows.

    References
    ----------
    .. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, appendix B.
    """
    levels, slope = np.empty_like(samples), np.empty_like(samples)
    t = np.arange(1, int(np.ceil(_REACH * sigma)) + 1)
    taps = t * np.exp(-0.5 * (t / sigma) ** 2)
    filter_columns(samples, columns.spans, 0.0, (taps / (2 * t * taps).sum()).astype(np.float32), -1.0, slope)
    t = np.arange(1, int(np.ceil(_REACH * _FINE * sigma)) + 1)
    taps = np.exp(-0.5 * (t / (_FINE * sigma)) ** 2)
    whole = float(1 + 2 * taps.sum())
    filter_columns(samples, columns.spans, 1 / whole, (taps / whole).astype(np.float32), 1.0, levels)
    return Profiles(columns, levels, slope, sigma)


def first_echoes(profiles: Profiles, score: Float32Array, threshold: float, place: Place) -> Edges:
    """Find in each column the first edge whose score exceeds a threshold, or else that of the largest score.

    Parameters
    ----------
    score : ndarray, shape (n, r)
        Slope or brightness, by which edges are judged.
    place : str
        See `LineSettings`.
    """
    spans = profiles.columns.spans
    steepest, front, peak, strength = np.empty((4, len(score)))
    found = np.empty(len(score), np.int64)
    first_edges(profiles.slope, score, spans, threshold, steepest, strength, found)
    echo_fronts(profiles.levels, spans, found, steepest, profiles.sigma, front, peak)
    return Edges({"front": front, "slope": steepest, "peak": peak}[place], strength)
