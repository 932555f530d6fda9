"""What curves may be wrong by at each depth, and what a sweep says of it.

A lens that focuses elsewhere, another aperture or other tissue makes the curves wrong by a factor at each
depth, and physics says which factors go together (`speckle3d.motion.diffraction`). All depths of one image
move together, so that a sweep shows the factors but for what they have in common; by their joint covariance
what it shows tells of the common part, too. All is Gaussian in logarithms of distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.optimize import least_squares

from speckle3d.core.arrays import FloatArray
from speckle3d.core.curves import DecorrelationCurves, Origin, TiltResponse
from speckle3d.core.sweep import RFSettings
from speckle3d.motion.curve_doubts import LEAST_ROWS, DepthFactors
from speckle3d.motion.diffraction import Lens, Nominal, half_distance

F_NUMBER = 2.0
"""Assumed of the transmit aperture at the lens's focus."""
BAND_HZ = 5e6, 10e6
"""Assumed for images without phase; the aperture that is then found makes up for it."""
TOLERANCES: dict[Origin, tuple[float, float, float, float]] = {
    "phantom": (0.10, 0.05, 0.3, 0.02),
    "data sheet": (0.15, 0.10, 0.2, 0.08),
    "tracked": (0.01, 0.01, 0.3, 0.01),
    "crossing": (0.01, 0.01, 0.3, 0.01),
}
"""By origin of the curves: what focus, aperture, attenuation (dB/cm/MHz) and frequency may be off."""
ROW_SIGMA = 0.015
"""Of a row's factor beside its likelihood's: curves of three blocks of phantom have 0.012."""
SHARE_SIGMA = 0.25
"""The same for each unit of a row's coherent share: fascia and fibres read up to 7 % shorter than speckle at
the depths between them, with a share of 0.3."""
NEAR_SIGMA, NEAR_MM = 0.1, 5.0
"""Error of diffraction near the probe, where the unknown transmit aperture matters, and how it fades."""
FREE_SIGMA: dict[Origin, float] = {"phantom": 0.03, "data sheet": 0.03, "tracked": 0.01, "crossing": 0.01}
"""By origin: error of all distances alike that goes with no lens; of the model, and of tissue's structure."""
MOST_FITS = 15
ANY_SCALE = 1.0
"""Deviation of the logarithm of a sweep's scale of which nothing is known."""
BELONGING = np.log(2.0)
"""Logarithm of the odds, before a sweep is looked at, for curves that belong to it."""
BENT = 2.0
"""Standard deviations of the sum of squares by which rows disagree, from which another lens is looked for."""
LEAST_LEFT = 0.7
"""Part of a mismatch that is still claimed, however sure the bend seems: of a length 12 % off 8 % were left
on one phantom where the fit's own deviation was 4 %."""
_STARTS, _START_F_NUMBER = (0.3, 0.5, 0.8, 1.3), 4.0
_DEPTHS = 7
FREQUENCY_SIGMA = 0.08
"""Of the echo's frequency over the band's centre."""


@dataclass(frozen=True)
class RowsSeen:
    """Distances that rows of patches want, over those of the path they were read to lie on.

    Attributes
    ----------
    depth_mm, logarithm, sigma : ndarray, shape (r,)
    log_scale, log_scale_sigma : float
        Of the true path over the one read.
    """

    depth_mm: FloatArray
    logarithm: FloatArray
    sigma: FloatArray
    log_scale: float = 0.0
    log_scale_sigma: float = ANY_SCALE


@dataclass(frozen=True)
class CurveCorrection:
    """Factors on the distances of curves.

    Attributes
    ----------
    depth_mm, logarithm : ndarray, shape (k,)
    sigma : float
        Relative standard deviation of what is left, over the rows that were seen.
    log_odds : float
        For these factors against none.
    """

    depth_mm: FloatArray
    logarithm: FloatArray
    sigma: float
    log_odds: float

    def applied(self, curves: DecorrelationCurves) -> DecorrelationCurves:
        """Stretch curves, each depth by its factor."""
        factor = np.exp(np.interp(curves.depth_mm, self.depth_mm, self.logarithm))
        grid = curves.distance_mm
        roots = np.sqrt(-np.log(curves.correlation))
        stretched = np.stack([_read(grid / f, grid, row) for f, row in zip(factor, roots, strict=True)])
        tilt = curves.tilt and TiltResponse(curves.tilt.pivot_mm, factor**2 * curves.tilt.spread_mm)
        return replace(curves, correlation=np.exp(-(stretched**2)), tilt=tilt)


def _read(at: FloatArray, grid: FloatArray, values: FloatArray) -> FloatArray:
    """Read a rising curve, going on as it ends."""
    slope = max((values[-1] - values[-6]) / (grid[-1] - grid[-6]), 0.0)
    return np.asarray(np.interp(at, grid, values) + slope * np.maximum(at - grid[-1], 0.0))


def rows_seen(factors: DepthFactors, share: FloatArray | None = None) -> RowsSeen:
    """What a sweep's rows say, with the errors that curves and coherent structure leave in them.

    Parameters
    ----------
    factors : DepthFactors
    share : ndarray, shape (r,), optional
        Mean coherent share of each row.
    """
    structure = 0.0 if share is None else SHARE_SIGMA * share
    sigma = np.sqrt(factors.sigma**2 + ROW_SIGMA**2 + structure**2)
    # What all rows have in common is the path's, which was found with them.
    mean = np.average(factors.logarithm, weights=sigma**-2)
    return RowsSeen(factors.depth_mm, factors.logarithm - mean, sigma)


def straightened(
    curves: DecorrelationCurves, seen: RowsSeen, mismatch: float
) -> tuple[DecorrelationCurves, float]:
    """Correct curves by what the depths of one sweep disagree on, as far as the curves are to be doubted.

    Of measured curves, the factors of the likeliest lens are taken with the probability that there is another
    lens at all, so that curves that belong to the sweep stay as they are.

    Parameters
    ----------
    mismatch : float
        Relative standard deviation of what all distances may be wrong by.

    Returns
    -------
    DecorrelationCurves
    float
        The same of what they may be wrong by now.
    """
    sheet = curves.origin == "data sheet"
    weight = 1.0 / seen.sigma**2
    off = seen.logarithm - np.average(seen.logarithm, weights=weight)
    free = seen.depth_mm.size - 1
    straight = (off**2 * weight).sum() < free + BENT * np.sqrt(2.0 * free)
    if free < LEAST_ROWS or (straight and not sheet):
        return curves, mismatch
    found = learn_correction(curves, [seen])
    # No lens is exactly as its data sheet says.
    chance = 1.0 if sheet else float(1.0 / (1.0 + np.exp(BELONGING - found.log_odds)))
    mean = float(np.interp(seen.depth_mm, found.depth_mm, found.logarithm).mean())
    left = chance * found.sigma**2 + (1.0 - chance) * (mismatch**2 + chance * mean**2)
    partly = replace(found, logarithm=chance * found.logarithm)
    return partly.applied(curves), float(np.clip(np.sqrt(left), LEAST_LEFT * mismatch, mismatch))


def learn_correction(
    curves: DecorrelationCurves, seen: Sequence[RowsSeen], free_sigma: float | None = None
) -> CurveCorrection:
    """Most likely factors on the curves' distances, given what sweeps show.

    Unknown are how far focus, aperture, attenuation and frequency are from those that the curves have, what
    goes with none of them, and each sweep's scale. What focus does is not linear: the depth at which curves
    are narrow moves with it.

    Parameters
    ----------
    seen : sequence of RowsSeen
        Of sweeps that were read with these curves.
    free_sigma : float, optional
        Error of all distances alike that goes with no lens; by default by the curves' origin.
    """
    free = FREE_SIGMA[curves.origin] if free_sigma is None else free_sigma
    family = _Family.of(curves, np.concatenate([each.depth_mm for each in seen]), free)
    left = np.concatenate([each.logarithm for each in seen])
    sigma = np.concatenate([each.sigma for each in seen])
    belongs = np.repeat(np.arange(len(seen)), [each.depth_mm.size for each in seen])
    known = np.array([each.log_scale for each in seen])
    known_sigma = np.array([each.log_scale_sigma for each in seen])
    count = family.size

    def misfit(values: FloatArray) -> FloatArray:
        scale = known + known_sigma * values[count:]
        rows = (left - scale[belongs] + family.factors(values[:count])) / sigma
        return np.concatenate([rows, values])

    start = np.zeros(count + len(seen))
    fit = least_squares(misfit, start, diff_step=0.03 * np.ones(start.size), x_scale=1.0, max_nfev=MOST_FITS)
    jacobian = np.asarray(fit.jac)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    rows = left.size
    along = np.zeros(start.size)
    along[:count] = (jacobian[:rows, :count] * sigma[:, None]).mean(axis=0)
    # Without any other lens the scales alone are free: a straight problem.
    alone = np.zeros((rows, len(seen)))
    alone[np.arange(rows), belongs] = known_sigma[belongs] / sigma
    normal = alone.T @ alone + np.eye(len(seen))
    plain = (left - known[belongs]) / sigma
    cost = plain @ plain - plain @ alone @ np.linalg.solve(normal, alone.T @ plain)
    gained = 0.5 * (cost - 2.0 * fit.cost)
    odds = gained + 0.5 * (np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(normal)[1])
    factors = _Family.of(curves, curves.depth_mm, free).factors(fit.x[:count])
    return CurveCorrection(curves.depth_mm, factors, float(np.sqrt(along @ covariance @ along)), float(odds))


@dataclass(frozen=True)
class _Family:
    """Curves' logarithmic errors at some depths for any lens and tissue near the nominal one.

    Parameters are in standard deviations: focus, aperture, attenuation, frequency, what the model lacks near
    the probe, and what all depths have in common beside.
    """

    nominal: Nominal
    depth_mm: FloatArray
    tolerance: FloatArray
    near: FloatArray
    free: float
    width: FloatArray

    size = 6

    @classmethod
    def of(cls, curves: DecorrelationCurves, depth_mm: FloatArray, free: float) -> _Family:
        nominal, depths = nominal_probe(curves), np.unique(depth_mm)
        near = NEAR_SIGMA if curves.origin == "data sheet" else 0.0
        tolerance = np.array(TOLERANCES[curves.origin]) / np.sqrt(3.0)
        return cls(
            nominal,
            depth_mm,
            tolerance,
            near * np.exp(-depth_mm / NEAR_MM),
            free,
            np.interp(depth_mm, depths, nominal.log_width(depths)),
        )

    def factors(self, values: FloatArray) -> FloatArray:
        """Logarithm of true over given distances, at the depths."""
        depths = np.unique(self.depth_mm)
        # Derivatives by what is not the lens' are asked for at the same lens.
        width = _log_width(
            self.nominal, tuple((values[:4] * self.tolerance).tolist()), tuple(depths.tolist())
        )
        changed = np.interp(self.depth_mm, depths, width) - self.width
        return np.asarray(changed + values[4] * self.near + values[5] * self.free)


@lru_cache(maxsize=16)
def _log_width(nominal: Nominal, off: tuple[float, ...], depth_mm: tuple[float, ...]) -> FloatArray:
    """`Nominal.log_width` of a lens that is off: focus, aperture and frequency by logarithms, attenuation."""
    focus, aperture, attenuation, frequency = off
    lens = replace(
        nominal.lens,
        focus_mm=nominal.lens.focus_mm * np.exp(focus),
        aperture_mm=nominal.lens.aperture_mm * np.exp(aperture),
    )
    low, high = (float(f * np.exp(frequency)) for f in nominal.band_hz)
    more = nominal.attenuation_db_cm_mhz + attenuation
    other = replace(nominal, lens=lens, band_hz=(low, high), attenuation_db_cm_mhz=more)
    return other.log_width(np.array(depth_mm))


def nominal_probe(curves: DecorrelationCurves) -> Nominal:
    """Probe that curves were calculated for; of measured ones that which makes them as wide."""
    if (given := curves.nominal) is not None:
        lens = Lens(given.aperture_mm, given.focus_mm, given.transmit_mm)
        return Nominal(lens, (given.low_hz, given.high_hz), given.attenuation_db_cm_mhz)
    band = curves.key.signal.bandwidth_hz if isinstance(curves.key.signal, RFSettings) else BAND_HZ
    width = np.log([half_distance(curves.distance_mm, row) for row in curves.correlation])
    return _fitted(band, tuple(curves.depth_mm.tolist()), tuple(width.tolist()))


@lru_cache(maxsize=8)
def _fitted(band_hz: tuple[float, float], depth_mm: tuple[float, ...], width: tuple[float, ...]) -> Nominal:
    depths = np.linspace(depth_mm[0], depth_mm[-1], _DEPTHS)
    wanted = np.interp(depths, depth_mm, width)

    def of(values: FloatArray) -> Nominal:
        aperture, focus, pitch = (float(np.exp(value)) for value in values)
        lens = Lens(aperture, focus, focus / F_NUMBER)
        return Nominal(lens, (band_hz[0] * pitch, band_hz[1] * pitch))

    def misfit(values: FloatArray) -> FloatArray:
        return np.asarray(of(values).log_width(depths) - wanted)

    def doubted(values: FloatArray) -> FloatArray:
        return np.append(misfit(values) / 0.02, values[2] / FREQUENCY_SIGMA)

    low, high = np.log([0.5, 2.0, 0.7]), np.log([40.0, 4.0 * depths[-1], 1.4])

    def start(share: float) -> FloatArray:
        """Focus at a share of the depth, and the aperture that then makes the mean width."""
        focus = np.log(share * depths[-1])
        first = np.array([focus - np.log(_START_F_NUMBER), focus, 0.0])
        first[0] += misfit(first).mean()
        return np.asarray(np.clip(first, low + 1e-3, high - 1e-3))

    def distance(values: FloatArray) -> float:
        return float(np.abs(misfit(values)).sum())

    best = min(map(start, _STARTS), key=distance)
    fit = least_squares(doubted, best, bounds=(low, high), diff_step=np.full(3, 1e-2), xtol=1e-3, max_nfev=10)
    return of(np.asarray(fit.x))
