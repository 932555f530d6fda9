"""Fit decorrelation curves by depth to phantom sweeps.

The curves are measured on phantoms moved by known distances. They belong to a probe, its settings and
a patch size; off the elevational focus it is the wavefront's curvature rather than the beam's width that
sets them, so they are measured at each depth and not derived from a beam width.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.curves import CurveKey, DecorrelationCurves, TiltResponse, curve_widths
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.leastsquares import robust_sigma
from speckle3d.core.sweep import RFSettings
from speckle3d.kernels.statistics import correlation_variance
from speckle3d.matching.intensity import two_way_wavenumber
from speckle3d.motion.planes import LEVEL_END

TILT_ROUNDS = 4
"""Fits of curves and of the response to tilt, each from the other: with one, sweeps whose frames tilt read up
to 12 % off, with two as with four."""
LITTLE_TILT = 0.1
"""Curves are fitted to frames whose turning changes distances by at most this share of them and a bin. With
all frames, sweeps that tilt by a degree a pair read 6 % off."""
BIN_MM = 0.05
"""Distances are averaged over: exact repeats of a phantom in such steps share one."""
PAIRS_PER_FACT = 20.0
"""Frame pairs per independent piece of information: pairs share frames."""
SURE_MM = 4.0
"""Standard deviation below which a pivot counts as learnt, a fraction of the probe's focal length."""


class CurveSettings(BaseModel):
    """Settings of the fit of decorrelation curves."""

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
    """Correlations between phantom frames at known distances.

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
    s, every = settings or CurveSettings(), list(samples)
    depth, offset, tilt, rho = (
        np.concatenate([getattr(sample, name)[np.isfinite(sample.correlation)] for sample in every])
        for name in ("depth_mm", "offset_mm", "tilt_rad", "correlation")
    )
    (rows, row), grid = np.unique(np.round(depth, 6), return_inverse=True), np.linspace(0, s.largest_mm, 251)
    of_echo, distance = key.correlation_of == "echo", np.abs(offset)
    fair = np.ones(depth.size, dtype=bool)
    # Turning distorts the curves a little and is itself read from them: estimate both in turn.
    for _ in range(TILT_ROUNDS):
        members = [np.flatnonzero(fair & (row == number)) for number in range(rows.size)]
        fits = [
            _fit_row(at, grid, s.terms, of_echo, distance[member], rho[member])
            for at, member in zip(rows, members, strict=True)
        ]
        curves, cells, ends = (np.array(part) for part in zip(*fits, strict=True))
        response = _fit_tilt(key, DecorrelationCurves(key, rows, grid, curves, cells), row, offset, tilt, rho)
        if response is None:
            break
        pivot, spread = response.pivot_mm[row], response.spread_mm[row]
        distance = np.hypot(offset - pivot * tilt, spread * tilt)
        fair = np.abs(distance - np.abs(offset)) <= LITTLE_TILT * (np.abs(offset) + BIN_MM)
    grid = grid[: max(2, int(np.searchsorted(grid, ends.min(), side="right")))]
    pairs = sum(sample.pairs for sample in every)
    return DecorrelationCurves(key, rows, grid, curves[:, : grid.size], cells, pairs, response)


def _fit_row(
    depth_mm: float, grid: FloatArray, terms: int, of_echo: bool, distance: FloatArray, rho: FloatArray
) -> tuple[FloatArray, float, float]:
    """Curve of one depth on `grid`, its number of speckle cells, and its last distance.

    A curve that has fallen as low as can be told goes on; one whose phantom did not go so far ends there.
    """
    _, group, count = np.unique(np.round(distance / BIN_MM), return_inverse=True, return_counts=True)
    centre, mean = (np.bincount(group, values) / count for values in (distance, rho))
    # The fit of in-plane motion finds a little correlation in frames that share no speckle. Curves include
    # it, so that it is not taken for coherent scattering in a sweep.
    low = centre[mean < LEVEL_END]
    far = mean[centre > 1.5 * low[0]] if low.size else mean[:0]
    floor = float(np.clip(far.mean(), 0.0, LEVEL_END / 2)) if far.size >= 3 else 0.0
    excess = (mean - floor) / (1 - floor)
    # Where a curve has levelled out it tells no distance: fit what lies before the first bin below the least.
    below = np.flatnonzero(excess < LEVEL_END)
    stop = int(below[0]) if below.size else mean.size
    centre, excess = centre[:stop], excess[:stop]
    if centre.size < 3 or excess.min() > 0.6:
        raise InsufficientDataError(
            f"curves at {depth_mm:.1f} mm depth: expected phantom frames at 3 or more distances "
            f"over which the correlation falls below 0.6, got {centre.size} "
            f"down to {excess.min() if excess.size else 1:.2f}"
        )
    curve = floor + (1 - floor) * np.exp(-_fitted_fall(grid, centre, excess, min(terms, centre.size - 2)))
    used = distance <= centre[-1]
    expected = np.interp(distance[used], grid, curve)
    cells = 60.0
    for _ in range(4):
        deviation = np.sqrt(correlation_variance(expected, cells, of_echo) + 1e-6)
        cells /= robust_sigma((rho[used] - expected) / deviation) ** 2
    return curve, cells, float(grid[-1] if below.size else centre[-1])


def _fitted_fall(grid: FloatArray, centre: FloatArray, rho: FloatArray, terms: int) -> FloatArray:
    """Rise of -ln(rho) with distance on `grid`: a polynomial in squared distance, then a straight line."""
    reach = centre[-1]
    coefficients = np.polyfit((centre / reach) ** 2, -np.log(rho), terms, w=rho / (1 - rho**2 + 0.01))
    coefficients[-1] = max(coefficients[-1], 1e-6)
    fall = np.polyval(coefficients, (np.minimum(grid, reach) / reach) ** 2)
    last = int(np.searchsorted(grid, reach, side="right")) - 1
    slope = max((fall[last] - fall[last - 5]) / (grid[1] * 5), 1e-3)
    fall = fall[np.minimum(np.arange(grid.size), last)] + slope * np.maximum(grid - grid[last], 0.0)
    return np.asarray(np.maximum.accumulate(fall + 1e-9 * np.arange(fall.size)))


def _fit_tilt(
    key: CurveKey,
    curves: DecorrelationCurves,
    row: IntArray,
    offset_mm: FloatArray,
    tilt_rad: FloatArray,
    rho: FloatArray,
) -> TiltResponse | None:
    """Fit the pivot at each depth to phantom frames that turned; None if they hardly did.

    Wavefronts change slowly with depth: it is a parabola. Spread and pivot cannot be separated while frames
    turn about the probe's face; the spread is therefore that of a Gaussian beam of the curves' own width:
    two-way wavenumber times width squared.

    Parameters
    ----------
    row : ndarray of int, shape (n,)
        Of the curves at each sample's depth.
    """
    depth, step, of_echo = curves.depth_mm, float(curves.distance_mm[1]), key.correlation_of == "echo"
    wavenumber = two_way_wavenumber(key.signal) if isinstance(key.signal, RFSettings) else 0.0
    spread = wavenumber * curve_widths(curves.distance_mm, curves.correlation) ** 2
    turned = (tilt_rad != 0.0) & (np.abs(offset_mm) < curves.distance_mm[-1])
    row, offset, tilt, rho = row[turned], offset_mm[turned], tilt_rad[turned], rho[turned]
    if np.bincount(row, minlength=depth.size).min() < 4 * PAIRS_PER_FACT:
        return None
    design = np.vander((depth - depth.mean()) / max(np.ptp(depth), 1.0), min(3, depth.size))

    def misfit(values: FloatArray) -> FloatArray:
        at = np.hypot(offset - (design @ values)[row] * tilt, spread[row] * tilt) / step
        expected = map_coordinates(curves.correlation, [row, at], order=1, mode="nearest")
        variance = correlation_variance(
            np.minimum(expected, 0.98), curves.cells[row] / PAIRS_PER_FACT, of_echo
        )
        return np.asarray((rho - expected) / np.sqrt(variance))

    fit = least_squares(misfit, np.zeros(design.shape[1]), loss="soft_l1")
    jacobian = np.asarray(fit.jac)
    covariance = np.linalg.pinv(jacobian.T @ jacobian)
    deviation = np.sqrt(np.einsum("ri,ij,rj->r", design, covariance, design))
    return TiltResponse(design @ fit.x, spread) if np.median(deviation) <= SURE_MM else None
