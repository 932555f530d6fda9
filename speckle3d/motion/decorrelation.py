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
from scipy.optimize import least_squares

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.curves import CurveKey, DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.sweep import RFSettings
from speckle3d.kernels.statistics import correlation_variance
from speckle3d.matching.intensity import two_way_wavenumber
from speckle3d.motion.tilt import effective_distance, fit_tilt_response

TILT_ROUNDS = 4
LITTLE_TILT, LITTLE_TILT_MM = 0.1, 0.01
"""Curves are fitted to frames whose turning changes distances by no more than this."""
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
    depth_mm, offset_mm, tilt_rad, correlation : ndarray, shape (n,)
        Of each patch in each pair; the offset is signed as the tilt is.
    pairs : int
        Frame pairs they come from.
    """

    depth_mm: FloatArray
    offset_mm: FloatArray
    tilt_rad: FloatArray
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
    depth, offset, tilt, rho = (
        np.concatenate([getattr(one, name) for one in every])
        for name in ("depth_mm", "offset_mm", "tilt_rad", "correlation")
    )
    rows = np.unique(np.round(depth, 6))
    grid = np.linspace(0.0, s.largest_mm, 251)
    distance, response = np.abs(offset), None
    of_echo = key.correlation_of == "echo"
    fair = np.ones(depth.size, dtype=bool)
    # Frames that turn distort the curves a little, and the curves say what turning does.
    for turn in range(TILT_ROUNDS):
        fitted = [
            _fit_row(row, grid, s.terms, of_echo, *_select(fair, depth, row, distance, rho)) for row in rows
        ]
        curves, cells = np.stack([curve for curve, _ in fitted]), np.array([count for _, count in fitted])
        if turn == TILT_ROUNDS - 1:
            break
        response = fit_tilt_response(
            rows, curves, cells, grid, _wavenumber(key), of_echo, (depth, offset, tilt, rho)
        )
        if response is None:
            break
        here = response.at(depth, rows)
        distance = effective_distance(offset, tilt, here.pivot_mm, here.spread_mm)
        fair = np.abs(distance - np.abs(offset)) <= LITTLE_TILT_MM + LITTLE_TILT * np.abs(offset)
    return DecorrelationCurves(key, rows, grid, curves, cells, sum(one.pairs for one in every), response)


def _wavenumber(key: CurveKey) -> float:
    """Two-way wavenumber, 1/mm; zero for B-mode images, whose frequency is not known."""
    return two_way_wavenumber(key.signal) if isinstance(key.signal, RFSettings) else 0.0


def _select(fair: BoolArray, depth: FloatArray, row: float, *columns: FloatArray) -> tuple[FloatArray, ...]:
    here = fair & (np.abs(depth - row) < 1e-5)
    return tuple(c[here & np.isfinite(columns[1])] for c in columns)


def _fit_row(
    depth_mm: float,
    grid: FloatArray,
    terms: int,
    of_echo: bool,
    distance: FloatArray,
    rho: FloatArray,
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
    return curve, _cells(rho[used] - expected, expected, of_echo)


def _cells(left: FloatArray, expected: FloatArray, of_echo: bool) -> float:
    """Number of independent cells that explains the residuals' spread."""
    cells = 60.0
    for _ in range(4):
        variance = correlation_variance(expected, cells, of_echo) + 1e-6
        cells /= (1.4826 * float(np.median(np.abs(left) / np.sqrt(variance)))) ** 2
    return cells


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
    weight = 1 / (1 - rho**2 + 0.01)
    log_weight = rho * weight
    start = np.linalg.lstsq(design * log_weight[:, None], -np.log(rho) * log_weight, rcond=None)[0]
    # The logarithm of a mean is not the mean of logarithms: the last word has the correlation itself.
    coefficients = least_squares(_misfit, start, args=(design, rho, weight)).x
    coefficients[0] = max(coefficients[0], 1e-6)
    inside = grid <= reach
    fall = (grid[inside, None] / reach) ** (2 * np.arange(terms + 1)) @ coefficients
    slope = max((fall[-1] - fall[-6]) / (grid[1] * 5), 1e-3)
    fall = np.concatenate([fall, fall[-1] + slope * (grid[~inside] - grid[inside][-1])])
    return np.asarray(np.maximum.accumulate(fall + 1e-9 * np.arange(fall.size)))


def _misfit(coefficients: FloatArray, design: FloatArray, rho: FloatArray, weight: FloatArray) -> FloatArray:
    return np.asarray((np.exp(-design @ coefficients) - rho) * weight)


def _bin_means(distance: FloatArray, rho: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means over bins of equal distance: at exact repeats for a stepped phantom, else 0.05 mm wide."""
    width = 0.05
    _, label = np.unique(np.round(distance / width), return_inverse=True)
    count = np.bincount(label)
    return np.bincount(label, distance) / count, np.bincount(label, rho) / count
