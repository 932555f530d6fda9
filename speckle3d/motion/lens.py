"""Curves stretched by a factor at each depth, for another lens or a known length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np
from scipy.optimize import least_squares

from speckle3d.core.arrays import FloatArray
from speckle3d.core.curves import ATTENUATION_SIGMA, DecorrelationCurves, TiltResponse
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.sweep import RFSettings
from speckle3d.motion.coherence import NOISY_GAIN, ROW_SIGMA, RowScales
from speckle3d.motion.diffraction import Lens, Nominal, half_distance

FOCUS_SIGMA = 0.15
"""Standard deviation of the logarithm of the focal length about its data sheet's: the tolerance that sheets
state, 15 %. With 0.087, as if uniform, a focus 15 % off leaves up to 5 % more of the length over tissue."""
LEAST_ROWS = 4
F_NUMBER = 2.0
"""Assumed of the transmit aperture at the lens's focus."""
BAND_HZ = 5e6, 10e6
"""Assumed for images without phase; the aperture that is then fitted makes up for it."""
FREQUENCY_SIGMA = 0.08
"""Of the echo's frequency over the band's centre."""
_STARTS, _START_F_NUMBER, _DEPTHS = (0.3, 0.5, 0.8, 1.3), 4.0, 7


def stretched(curves: DecorrelationCurves, log_factor: FloatArray) -> DecorrelationCurves:
    """Multiply the distances of curves at each depth by exp(log_factor), shape (r,) or ()."""
    factor = np.broadcast_to(np.exp(log_factor), curves.depth_mm.shape)
    grid, roots = curves.distance_mm, np.sqrt(-np.log(curves.correlation))
    rows = [_extended(grid / f, grid, row) for f, row in zip(factor, roots, strict=True)]
    tilt = curves.tilt and TiltResponse(curves.tilt.pivot_mm, factor**2 * curves.tilt.spread_mm)
    return replace(curves, correlation=np.exp(-(np.stack(rows) ** 2)), tilt=tilt)


def _extended(at: FloatArray, grid: FloatArray, values: FloatArray) -> FloatArray:
    """Interpolate a rising curve, beyond its end along its last slope."""
    slope = max((values[-1] - values[-6]) / (grid[-1] - grid[-6]), 0.0)
    return np.asarray(np.interp(at, grid, values) + slope * np.maximum(at - grid[-1], 0.0))


def with_fitted_lens(
    curves: DecorrelationCurves, rows: RowScales, sheet_focus_mm: float
) -> DecorrelationCurves:
    """Fit the focal length of a data sheet's probe to the scales that rows of patches ask for.

    All depths of one image move together, so that rows show how far curves are wrong against each other; a
    lens that focuses elsewhere bends them in a known way, its common factor included.

    Parameters
    ----------
    curves : DecorrelationCurves
        From a data sheet.
    rows : RowScales
        Of a sweep that was read with them.
    sheet_focus_mm : float
        Focal length that the data sheet has, about which the fitted one is to be.

    Returns
    -------
    DecorrelationCurves
        Of the lens found, and with the `scale_sigma` given: rows of one sweep share errors of structure.
    """
    assert curves.nominal is not None
    clear = rows.gain >= NOISY_GAIN
    if clear.sum() < LEAST_ROWS:
        return curves
    # A row that reads long asks for narrower curves.
    sheet, depth, logarithm = curves.nominal, rows.depth_mm[clear], -rows.logarithm[clear]
    lens = Lens(sheet.aperture_mm, sheet.focus_mm, sheet.transmit_mm)
    nominal = Nominal(lens, (sheet.low_hz, sheet.high_hz), sheet.attenuation_db_cm_mhz)
    width = nominal.log_width(depth)

    def wider(focus: float, at: FloatArray, before: FloatArray) -> FloatArray:
        other = replace(lens, focus_mm=lens.focus_mm * float(np.exp(focus)))
        return replace(nominal, lens=other).log_width(at) - before

    moved = float(np.log(sheet.focus_mm / sheet_focus_mm))

    def misfit(values: FloatArray) -> FloatArray:
        left = (logarithm - values[1] - wider(values[0], depth, width)) / ROW_SIGMA
        # Rows may be wrong (the loss is SciPy's soft_l1), what the sheet says is not.
        robust = np.sign(left) * np.sqrt(2.0 * (np.hypot(1.0, left) - 1.0))
        return np.append(robust, (values[0] + moved) / FOCUS_SIGMA)

    start = np.array([0.0, np.median(logarithm)])
    fit = least_squares(misfit, start, diff_step=[0.03, 0.03], x_scale=[0.1, 0.1], max_nfev=20)
    at = np.clip(curves.depth_mm, depth[0], depth[-1])
    factor = wider(float(fit.x[0]), at, nominal.log_width(at))
    fitted = replace(sheet, focus_mm=sheet.focus_mm * float(np.exp(fit.x[0])))
    return replace(stretched(curves, factor), nominal=fitted)


@dataclass(frozen=True)
class Length:
    """Logarithm of a sweep's true elevational length over the images', and its standard deviation."""

    log_scale: float
    sigma: float


class TrackedSweep(Protocol):
    """A sweep that was read with curves, such as `speckle3d.pipeline.Tracked`."""

    @property
    def curves(self) -> DecorrelationCurves:
        """Curves it was read with."""


def corrected_curves(
    curves: DecorrelationCurves, tracked: Sequence[TrackedSweep], lengths: Sequence[Length]
) -> DecorrelationCurves:
    """Correct the curves of a probe by sweeps whose true length is known from a crossing or a tracker.

    All distances are multiplied by one factor; where the sweeps were read with another lens than `curves`
    have, its factors by depth go before it. Tissue whose structure reads short is corrected with it: curves
    learnt over tissue are right over tissue.

    Returns
    -------
    DecorrelationCurves
        Of origin "crossing"; their `scale_sigma` is that of the lengths and of tissue that attenuates
        otherwise.

    Raises
    ------
    InsufficientDataError
        If there is no sweep, or none whose length is known.
    """
    scale, sigma = (np.array([getattr(each, name) for each in lengths]) for name in ("log_scale", "sigma"))
    if not tracked or scale.size != len(tracked) or not (np.isfinite(scale) & (sigma > 0)).all():
        raise InsufficientDataError(
            "corrected curves: expected for every sweep a finite log scale with a deviation above zero, got "
            f"{scale.tolist()} and {sigma.tolist()} for {len(tracked)} sweeps"
        )
    weight = sigma**-2.0 / (sigma**-2.0).sum()
    lens = np.mean([_log_widths(each.curves) - _log_widths(curves) for each in tracked], axis=0)
    left = float(
        np.sqrt((weight * (scale - weight @ scale) ** 2).sum() / scale.size + 1.0 / (sigma**-2.0).sum())
    )
    # Widened for the attenuation of these sweeps, the curves go with a spectrum that has it.
    better = replace(stretched(curves, lens + weight @ scale), spectrum=tracked[0].curves.spectrum)
    return replace(better, scale_sigma=float(np.hypot(left, ATTENUATION_SIGMA)), origin="crossing")


def _log_widths(curves: DecorrelationCurves) -> FloatArray:
    return np.log([half_distance(curves.distance_mm, row) for row in curves.correlation])


def nominal_probe(curves: DecorrelationCurves) -> Nominal:
    """Probe that curves were calculated for; of measured ones the one whose calculated curves are as wide."""
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
