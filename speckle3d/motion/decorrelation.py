"""Decorrelation curves: how the correlation of speckle falls with elevational distance, by depth.

The curves are measured on a phantom moved by known distances. They belong to a probe, its settings and
a patch size; off the elevational focus it is the wavefront's curvature rather than the beam's width that
sets them, so they are measured at each depth and not derived from a beam width.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from speckle3d.core.curves import CurveKey, DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import FloatArray

LEAST_RHO = 0.1
"""Curves end where the phantom's correlation falls to this: below it a patch of some hundred cells cannot
tell one distance from another."""


class CurveSettings(BaseModel):
    """How curves are fitted."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    largest_mm: float = Field(2.5, gt=0, description="Largest separation of two phantom frames that is used.")
    terms: int = Field(3, ge=1, le=5, description="Order of -ln(rho) as a polynomial in squared distance.")
    pairs: int = Field(3000, ge=10, description="About how many frame pairs of each phantom sweep are used.")


@dataclass(frozen=True)
class PhantomSamples:
    """Correlations seen between phantom frames at known distances.

    Attributes
    ----------
    depth_mm, distance_mm, correlation : ndarray, shape (n,)
    pairs : int
        Frame pairs they come from.
    """

    depth_mm: FloatArray
    distance_mm: FloatArray
    correlation: FloatArray
    pairs: int


def fit_curves(
    key: CurveKey, samples: Iterable[PhantomSamples], settings: CurveSettings | None = None
) -> DecorrelationCurves:
    """Fit one smooth falling curve per depth to the samples of all phantom sweeps.

    -ln(rho) is a polynomial in squared distance without odd terms, since a beam looks the same from
    either side; its constant is what noise and interpolation cost at no distance at all.

    Raises
    ------
    InsufficientDataError
        If a depth has too few samples over too little of its curve.
    """
    s = settings or CurveSettings()
    every = list(samples)
    if not every:
        raise InsufficientDataError("expected samples of at least one phantom sweep, got none")
    depth, distance, rho = (
        np.concatenate([getattr(one, name) for one in every])
        for name in ("depth_mm", "distance_mm", "correlation")
    )
    rows = np.unique(np.round(depth, 6))
    grid = np.linspace(0.0, s.largest_mm, 251)
    fitted = [_fit_row(row, grid, s.terms, *_select(depth, row, distance, rho)) for row in rows]
    curves = np.stack([curve for curve, _ in fitted])
    return DecorrelationCurves(
        key, rows, grid, curves, np.array([cells for _, cells in fitted]), sum(one.pairs for one in every)
    )


def _select(depth: FloatArray, row: float, *columns: FloatArray) -> tuple[FloatArray, ...]:
    here = np.abs(depth - row) < 1e-5
    return tuple(c[here & np.isfinite(columns[1])] for c in columns)


def _fit_row(
    depth_mm: float, grid: FloatArray, terms: int, distance: FloatArray, rho: FloatArray
) -> tuple[FloatArray, float]:
    """Curve of one depth on `grid`, and the number of cells that explains the scatter about it."""
    centre, mean = _bin_means(distance, rho)
    floor = _floor(centre, mean)
    excess = (mean - floor) / (1 - floor)
    # A curve that levels out is past its use: fit what lies before the first bin under the least rho.
    below = np.flatnonzero(excess < LEAST_RHO)
    keep = slice(0, int(below[0]) if below.size else mean.size)
    centre, excess = centre[keep], excess[keep]
    if centre.size < 3 or excess.min() > 0.6:
        raise InsufficientDataError(
            f"curves at {depth_mm:.1f} mm depth: expected phantom frames at 3 or more distances "
            f"over which the correlation falls below 0.6, got {centre.size} "
            f"down to {excess.min() if excess.size else 1:.2f}"
        )
    curve = floor + (1 - floor) * np.exp(-_fitted_fall(grid, centre, excess, min(terms, centre.size - 2)))
    used = distance <= centre[-1]
    expected = np.interp(distance[used], grid, curve)
    spread = np.median(np.abs(rho[used] - expected) / (1 - expected**2 + 1e-3)) * 1.4826
    return curve, float(1.0 / spread**2)


def _floor(centre: FloatArray, mean: FloatArray) -> float:
    """Correlation that stays however far apart the frames are.

    Fitting the in-plane motion of frames that share nothing finds a little correlation all the same; the
    curves hold it, so that it is not taken for coherent scattering in a sweep.
    """
    below = np.flatnonzero(mean < LEAST_RHO)
    far = mean[centre > 1.5 * centre[below[0]]] if below.size else mean[:0]
    return float(np.clip(far.mean(), 0.0, LEAST_RHO / 2)) if far.size >= 3 else 0.0


def _fitted_fall(grid: FloatArray, centre: FloatArray, rho: FloatArray, terms: int) -> FloatArray:
    """Rise of -ln(rho) with distance on `grid`: a polynomial in squared distance, then a straight line."""
    reach = centre[-1]
    design = (centre[:, None] / reach) ** (2 * np.arange(terms + 1))
    weight = rho / (1 - rho**2 + 0.01)
    coefficients = np.linalg.lstsq(design * weight[:, None], -np.log(rho) * weight, rcond=None)[0]
    coefficients[0] = max(coefficients[0], 1e-6)
    inside = grid <= reach
    fall = (grid[inside, None] / reach) ** (2 * np.arange(terms + 1)) @ coefficients
    slope = max((fall[-1] - fall[-6]) / (grid[1] * 5), 1e-3)
    fall = np.concatenate([fall, fall[-1] + slope * (grid[~inside] - grid[inside][-1])])
    return np.asarray(np.maximum.accumulate(fall + 1e-9 * np.arange(fall.size)))


def _bin_means(distance: FloatArray, rho: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means over bins of equal distance: at exact repeats for a stepped phantom, else 0.05 mm wide."""
    width = 0.05
    _, label = np.unique(np.round(distance / width), return_inverse=True)
    count = np.bincount(label)
    return np.bincount(label, distance) / count, np.bincount(label, rho) / count
