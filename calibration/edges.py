"""The first strong echo in each column: a steep rise of the smoothed levels, then its front or its peak."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from calibration.columns import Columns
from speckle3d.core.geometry import FloatArray
from speckle3d.kernels.lines import echo_fronts, edge_response, first_edges

Float32Array = npt.NDArray[np.float32]
Place = Literal["front", "slope", "peak"]

_FINE = 0.25
"""Smoothing with which an echo is placed, as a part of that with which it is found: enough against noise, and
short against the rise of an echo."""
_REACH = 3.5
"""Length of the filters' sides, standard deviations."""


@dataclass(frozen=True)
class Slopes:
    """Columns of an image and how steeply their smoothed levels rise.

    Attributes
    ----------
    samples, response : ndarray, shape (n, r)
        Levels, and levels per row.
    columns : Columns
    sigma : float
        Of the smoothing, rows.
    """

    samples: Float32Array
    response: Float32Array
    columns: Columns
    sigma: float

    @property
    def typical(self) -> float:
        """Largest response of the middle one of all columns, by response."""
        held = self.columns.inside.any(axis=1)
        return float(np.median(self.response[held].max(axis=1)))


@dataclass(frozen=True)
class Edges:
    """One edge in each column.

    Attributes
    ----------
    row : ndarray, shape (n,)
        Where the echo is; NaN without one.
    strength : ndarray, shape (n,)
        Levels per row; 0 without one.
    """

    row: FloatArray
    strength: FloatArray


def take_slopes(samples: Float32Array, columns: Columns, sigma: float) -> Slopes:
    """Differentiate columns smoothed by a Gaussian, in one convolution; nothing outside the region counts.

    Parameters
    ----------
    samples : ndarray, shape (n, r)
    sigma : float
        Of the Gaussian, rows.

    References
    ----------
    .. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, appendix B.
    """
    t = np.arange(1, int(np.ceil(_REACH * sigma)) + 1)
    taps = t * np.exp(-0.5 * (t / sigma) ** 2)
    response = np.empty_like(samples)
    edge_response(samples, columns.spans, (taps / (2 * t * taps).sum()).astype(np.float32), response)
    return Slopes(samples, response, columns, sigma)


def first_echoes(slopes: Slopes, threshold: float, place: Place) -> Edges:
    """Find in each column the first rise steeper than a threshold, or else the steepest, and place its echo.

    Parameters
    ----------
    threshold : float
        Levels per row.
    place : str
        See `LineSettings`.
    """
    spans = slopes.columns.spans
    steepest, front, peak, strength = np.empty((4, len(slopes.samples)))
    found = np.empty(len(slopes.samples), np.int64)
    first_edges(slopes.response, spans, threshold, steepest, strength, found)
    if place == "slope":
        return Edges(steepest, strength)
    t = np.arange(int(np.ceil(_REACH * _FINE * slopes.sigma)) + 1)
    taps = np.exp(-0.5 * (t / (_FINE * slopes.sigma)) ** 2)
    taps = (taps / (2 * taps.sum() - 1)).astype(np.float32)
    echo_fronts(slopes.samples, spans, found, steepest, taps, slopes.sigma, front, peak)
    return Edges(front if place == "front" else peak, strength)
