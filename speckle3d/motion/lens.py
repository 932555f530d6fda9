"""Stretch decorrelation curves by depth, for another lens."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline

from speckle3d.core.arrays import FloatArray
from speckle3d.core.curves import DecorrelationCurves, NominalProbe, TiltResponse
from speckle3d.motion.coherence import NOISY_GAIN, ROW_SIGMA, RowScales
from speckle3d.motion.diffraction import log_width

FOCUS_SIGMA = 0.15
"""Standard deviation of the logarithm of the focal length about its data sheet's: the tolerance that sheets
state, 15 %. With 0.087, as if uniform, a focus 15 % off leaves up to 5 % more of the length over tissue."""


def stretched(curves: DecorrelationCurves, log_factor: FloatArray) -> DecorrelationCurves:
    """Multiply the distances of curves at each depth by exp(log_factor), shape (r,) or ()."""
    factor = np.broadcast_to(np.exp(log_factor), curves.depth_mm.shape)
    grid, roots = curves.distance_mm, np.sqrt(-np.log(curves.correlation))
    # Beyond its end a curve goes on along its last slope.
    rows = [make_interp_spline(grid, row, k=1)(grid / f) for f, row in zip(factor, roots, strict=True)]
    tilt = curves.tilt and TiltResponse(curves.tilt.pivot_mm, factor**2 * curves.tilt.spread_mm)
    return replace(
        curves, correlation=np.exp(-(np.maximum.accumulate(np.stack(rows), axis=1) ** 2)), tilt=tilt
    )


def with_fitted_lens(curves: DecorrelationCurves, rows: RowScales) -> DecorrelationCurves:
    """Fit the focal length of a data sheet's probe to the distance scales of rows of patches.

    All depths of one image move together, so that rows show how far curves are wrong against each other; a
    lens that focuses elsewhere bends them in a known way, its common factor included.

    Parameters
    ----------
    curves : DecorrelationCurves
        From a data sheet, about whose focal length the fitted one is to be.
    rows : RowScales
        Of a sweep that was read with them.
    """
    sheet = curves.nominal
    assert sheet is not None
    clear = rows.gain >= NOISY_GAIN
    if not clear.any():
        return curves
    width = _log_widths_by_focus(sheet, tuple(rows.depth_mm.tolist()))
    focus = np.linspace(width.x[0], width.x[-1], 601)
    wider = width(focus) - width(0.0)
    # A row that reads long asks for narrower curves.
    left = -rows.logarithm[clear] - wider[:, clear]
    left = (left - np.median(left, axis=1, keepdims=True)) / ROW_SIGMA
    # Rows may be wrong (the loss is SciPy's soft_l1), what the sheet says is not.
    cost = 2.0 * (np.hypot(1.0, left) - 1.0).sum(axis=1) + (focus / FOCUS_SIGMA) ** 2
    best = int(cost.argmin())
    fitted = replace(sheet, focus_mm=sheet.focus_mm * float(np.exp(focus[best])))
    return replace(stretched(curves, np.interp(curves.depth_mm, rows.depth_mm, wider[best])), nominal=fitted)


@lru_cache(maxsize=2)
def _log_widths_by_focus(sheet: NominalProbe, depth_mm: tuple[float, ...]) -> CubicSpline:
    """Logarithm of the curves' widths at each depth by that of the focal length over the sheet's."""
    foci = FOCUS_SIGMA * np.linspace(-4.0, 4.0, 13)
    probes = [replace(sheet, focus_mm=sheet.focus_mm * float(np.exp(focus))) for focus in foci]
    return CubicSpline(foci, [log_width(probe, np.array(depth_mm)) for probe in probes])
