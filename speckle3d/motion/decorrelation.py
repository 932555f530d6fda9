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
from speckle3d.core.curves import CurveKey, DecorrelationCurves, TiltResponse
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.leastsquares import robust_sigma
from speckle3d.core.sweep import RFSettings
from speckle3d.kernels.statistics import correlation_variance
from speckle3d.matching.intensity import two_way_wavenumber

TILT_ROUNDS = 4
LITTLE_TILT, LITTLE_TILT_MM = 0.1, 0.01
"""Curves are fitted to frames whose turning changes distances by no more than this."""
LEAST_RHO = 0.1
"""Correlation at which curves end: below it a patch of some hundred cells cannot tell distances apart."""


class CurveSettings(BaseModel):
    """How curves are fitted."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    largest_mm: float = Field(2.5, gt=0, description="Largest separation of two phantom frames that is used.")
    terms: int = Field(3, ge=1, le=5, description="Order of -ln(rho) as a polynomial in squared distance.")
    pairs: int = Field(3000, ge=10, description="About how many frame pairs of each phantom sweep are used.")
    same_probe: bool = Field(
        False,
        description="The curves were measured on a phantom with the very probe that the sweep was made with, "
        "not only with one of its model: claimed errors of length then leave out what probes differ by.",
    )


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
    # Turning distorts the curves a little and is itself read from them: estimate both in turn.
    for turn in range(TILT_ROUNDS):
        fitted = [
            _fit_row(row, grid, s.terms, of_echo, *_select(fair, depth, row, distance, rho)) for row in rows
        ]
        curves, cells, ends = (np.array(part) for part in zip(*fitted, strict=True))
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
    grid = grid[: max(2, int(np.searchsorted(grid, ends.min(), side="right")))]
    pairs = sum(one.pairs for one in every)
    return DecorrelationCurves(key, rows, grid, curves[:, : grid.size], cells, pairs, response)


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
) -> tuple[FloatArray, float, float]:
    """Curve of one depth on `grid`, the cells that explain the scatter about it, and its last distance.

    A curve that has fallen as low as can be told goes on; one whose phantom did not go so far ends there.
    """
    centre, mean = _bin_means(distance, rho)
    floor = _floor(centre, mean)
    excess = (mean - floor) / (1 - floor)
    # Where a curve has levelled out it tells no distance: fit what lies before the first bin below the least.
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
    end = float(grid[-1] if below.size else centre[-1])
    return curve, _cells(rho[used] - expected, expected, of_echo), end


def _cells(left: FloatArray, expected: FloatArray, of_echo: bool) -> float:
    """Number of independent cells that explains the residuals' spread."""
    cells = 60.0
    for _ in range(4):
        variance = correlation_variance(expected, cells, of_echo) + 1e-6
        cells /= robust_sigma(left / np.sqrt(variance)) ** 2
    return cells


def _floor(centre: FloatArray, mean: FloatArray) -> float:
    """Correlation of frames however far apart.

    The fit of in-plane motion finds a little correlation in frames that share no speckle. Curves include it,
    so that it is not taken for coherent scattering in a sweep.
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
    # The mean of logarithms is not the logarithm of the mean, so the last fit is of the correlation itself.
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
    """Means over bins of distance 0.05 mm wide: exact repeats of a phantom in such steps share one."""
    width = 0.05
    _, label = np.unique(np.round(distance / width), return_inverse=True)
    count = np.bincount(label)
    return np.bincount(label, distance) / count, np.bincount(label, rho) / count


PAIRS_PER_FACT = 20.0
"""Frame pairs per independent piece of information: pairs share frames."""
SURE_MM = 4.0
"""Standard deviation below which a pivot counts as learnt, a fraction of the probe's focal length."""
TURNED_RAD = 1e-5


def effective_distance(
    offset_mm: FloatArray, tilt_rad: FloatArray, pivot_mm: FloatArray | float, spread_mm: FloatArray | float
) -> FloatArray:
    """Distance without tilt at which speckle would have decorrelated as much."""
    return np.asarray(np.hypot(offset_mm - pivot_mm * tilt_rad, spread_mm * tilt_rad))


def fit_tilt_response(
    depths_mm: FloatArray,
    curves: FloatArray,
    cells: FloatArray,
    distance_mm: FloatArray,
    wavenumber_per_mm: float,
    of_echo: bool,
    samples: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
) -> TiltResponse | None:
    """Fit the pivot at each depth to phantom frames that turned; None if they hardly did.

    Spread and pivot cannot be separated while frames turn about the probe's face; the spread is therefore
    that of a Gaussian beam of the curves' own width: two-way wavenumber times width squared.

    Parameters
    ----------
    depths_mm, cells : ndarray, shape (r,)
    curves : ndarray, shape (r, k)
        On `distance_mm`, shape (k,).
    wavenumber_per_mm : float
        Two-way, 4 pi over the wavelength; 0 if it is not known.
    samples : tuple of ndarray, each of shape (n,)
        Depth, signed offset, tilt, correlation.
    """
    depth, offset, tilt, rho = samples
    turned = np.isfinite(rho) & (np.abs(tilt) > TURNED_RAD) & (np.abs(offset) < distance_mm[-1])
    width = np.array([np.interp(0.5, -np.log(curve), distance_mm) for curve in curves])
    spread = wavenumber_per_mm * width**2
    fits = []
    for number, row in enumerate(depths_mm):
        here = turned & (np.abs(depth - row) < 1e-5)
        if here.sum() < 4 * PAIRS_PER_FACT:
            return None
        seen = offset[here], tilt[here], rho[here]
        fits.append(_fit_pivot(*seen, distance_mm, curves[number], cells[number], spread[number], of_echo))
    pivot, deviation = np.array(fits).T
    if np.median(deviation) > SURE_MM:
        return None
    # Wavefronts change slowly with depth.
    smooth = np.polynomial.Polynomial.fit(depths_mm, pivot, min(2, depths_mm.size - 1), w=1 / deviation)
    return TiltResponse(smooth(depths_mm), spread)


def _fit_pivot(
    offset: FloatArray,
    tilt: FloatArray,
    rho: FloatArray,
    distance_mm: FloatArray,
    curve: FloatArray,
    cells: float,
    spread: float,
    of_echo: bool,
) -> tuple[float, float]:
    """Pivot of one depth and its standard deviation."""

    def standard(pivot: FloatArray) -> FloatArray:
        expected = np.interp(effective_distance(offset, tilt, pivot[0], spread), distance_mm, curve)
        variance = correlation_variance(np.minimum(expected, 0.98), cells / PAIRS_PER_FACT, of_echo)
        return np.asarray((rho - expected) / np.sqrt(variance))

    starts = [least_squares(standard, [start], loss="soft_l1") for start in (-8.0, 0.0, 8.0)]
    fit = min(starts, key=lambda f: float(f.cost))
    return float(fit.x[0]), float(1 / np.sqrt(np.square(np.asarray(fit.jac)).sum() + 1e-9))
