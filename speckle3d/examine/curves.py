"""Check curves against a sweep's own correlations, speckle and patches.

A factor that all of a curve's distances have in common cannot be told from images: the same frames are then
seen as far apart, and everything below fits as well as before. What can be told is curves that are wrong by
another factor at each depth, since all depths of one image move together.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from speckle3d.core.arrays import FloatArray
from speckle3d.core.curves import DecorrelationCurves, SpeckleSize, curve_widths
from speckle3d.core.errors import Doubt, MismatchError, Speckle3DError
from speckle3d.core.sweep import RFSettings
from speckle3d.examine.sensors import REFUTED
from speckle3d.matching.patches import PatchGrid
from speckle3d.matching.texture import Texture
from speckle3d.motion.coherence import NOISY_GAIN, ROW_SIGMA, RowScales
from speckle3d.motion.estimate import Motion

BEND_DOUBT = 0.12
"""Standard deviation over depth of the logarithm of distances. Simulated: right curves up to 0.06 in phantom,
tissue and noise; of a lens whose focus is 10 % off 0.11; shipped ones 10 mm too high 0.20, reversed 0.53."""
SIZE_LIMITS = {"lateral_mm": (0.13, 0.3), "axial_mm": (0.3, 0.6)}
"""From which sizes are doubted, and refuted: median over depth of the logarithm of speckle sizes over the
phantom's, either sign. Simulated: lateral up to 0.03 in phantom, 0.10 in tissue, 0.19 to 0.31 at depths wrong
by 10 mm; axial 0.08, with attenuation wrong by 0.3 dB/cm/MHz 0.17, with a sampling rate wrong by a factor of
two 0.69."""
LEAST_ROWS = 4
"""Rows of patches from which doubts arise."""
_LEAST_RISE = 0.04
"""Of the mean frequency over the depth, over the bandwidth: over simulated tissue of 0.5 dB/cm/MHz it falls
by 0.14 in 4 cm."""
WIDEST_MM = 8.0
"""Distance over which no beam keeps 0.6 of its correlation: that of an unfocused element 35 mm high, which
keeps (1 - d / 35)^2 of the echo's. Probes' elements are 2 to 15 mm high, and focused."""


def examine_key(curves: DecorrelationCurves, all_patches: PatchGrid, patches: PatchGrid) -> tuple[Doubt, ...]:
    """Check curves against physical beams and against the sweep's patches.

    Raises
    ------
    MismatchError
        If the curves are no beam's.
    """
    return require_usable((doubt_depths(curves, all_patches, patches), doubt_width(curves)), MismatchError)


def doubt_depths(curves: DecorrelationCurves, all_patches: PatchGrid, patches: PatchGrid) -> Doubt | None:
    """Report patches left out because the curves do not cover their depths."""
    rows, common = all_patches.row_depth_mm, patches.row_depth_mm
    if rows.size == common.size:
        return None
    evidence = (
        f"expected patches at the curves' depths of {curves.depth_mm[0]:.1f} to {curves.depth_mm[-1]:.1f} "
        f"mm, got {rows[0]:.1f} to {rows[-1]:.1f} mm: {rows.size - common.size} of {rows.size} rows left out"
    )
    return Doubt("curves", "depths", evidence, False)


def doubt_width(curves: DecorrelationCurves) -> Doubt | None:
    """Refute curves that no beam has."""
    width = float(np.median(curve_widths(curves.distance_mm, curves.correlation)))
    evidence = f"expected correlation to fall within {WIDEST_MM:g} mm, got {width:.3g} mm"
    return Doubt("curves", "units", evidence, True) if width > WIDEST_MM else None


def require_usable(doubts: Iterable[Doubt | None], error: type[Speckle3DError]) -> tuple[Doubt, ...]:
    """Return the doubts; raise `error` with the first that refutes."""
    actual = tuple(doubt for doubt in doubts if doubt is not None)
    for doubt in actual:
        if doubt.refuted:
            raise error(str(doubt))
    return actual


def examine_curves(texture: Texture, motion: Motion) -> tuple[Doubt | None, ...]:
    """Check curves against a sweep's own speckle and steps."""
    rows, patches = rows_without_tilt(motion), motion.problem.patches
    gain = np.ones(patches.row_depth_mm.size) if rows is None else np.nan_to_num(rows.gain)
    return (
        *doubt_size(texture.speckle_size(), motion.problem.curves, patches, gain),
        doubt_bend(rows),
        doubt_sign(texture),
    )


def rows_without_tilt(motion: Motion) -> RowScales | None:
    """Scales of rows without the part that tilt explains, which may be wrong curves."""
    rows, problem = motion.coherence.rows, motion.problem
    if rows is None:
        return None
    lever = np.median(problem.patches.rows_of(problem.levers.lever_mm), axis=-1)
    by_tilt = np.log(np.maximum(np.abs(1.0 + motion.turn_per_mm[1] * lever), 1e-3))
    return replace(rows, logarithm=rows.logarithm + by_tilt - np.median(by_tilt))


def doubt_bend(rows: RowScales | None) -> Doubt | None:
    """Doubt curves with which depths of an image disagree smoothly.

    By the standard deviation of a parabola over depth through rows without noise: a lens or a depth that is
    wrong bends all rows smoothly; rows that stand out alone hold structure.
    """
    if rows is None or (rows.gain >= NOISY_GAIN).sum() < LEAST_ROWS:
        return None
    clear = rows.gain >= NOISY_GAIN
    depth, logarithm = rows.depth_mm[clear], rows.logarithm[clear]
    design = np.vander((depth - depth.mean()) / np.ptp(depth), 3)

    def misfit(values: FloatArray) -> FloatArray:
        return np.asarray(design @ values - logarithm)

    fit = least_squares(misfit, np.zeros(3), loss="soft_l1", f_scale=ROW_SIGMA)
    size = float(np.std(design @ fit.x))
    if size < BEND_DOUBT:
        return None
    ratio = np.exp(np.nanmax(rows.logarithm) - np.nanmin(rows.logarithm))
    evidence = (
        f"expected all depths to tell the same distance, got distances at {rows.depth_mm[0]:.0f} to "
        f"{rows.depth_mm[-1]:.0f} mm that differ by a factor of {ratio:.2f} ({100 * size:.0f} % rms, at most "
        f"{100 * BEND_DOUBT:.0f} expected)"
    )
    return Doubt("curves", "curves of another probe, lens or depth", evidence, size > REFUTED * BEND_DOUBT)


def doubt_size(
    speckle: SpeckleSize, curves: DecorrelationCurves, patches: PatchGrid, gain: FloatArray
) -> tuple[Doubt, ...]:
    """Doubt a sweep whose speckle is not as large as the curves' phantom's at the same depths.

    Parameters
    ----------
    speckle : SpeckleSize
        Of the rows of patches; NaN where they hold no speckle.
    gain : ndarray, shape (r,)
        Part of the correlation of each row of patches that noise leaves.
    """
    reference = curves.at(patches.row_depth_mm).speckle
    if reference is None:
        return ()
    doubts = []
    for name, (least, most) in SIZE_LIMITS.items():
        # Noise differs from sample to sample, so that speckle under it looks finer.
        fair = np.isfinite(getattr(speckle, name)) & (gain >= NOISY_GAIN)
        if fair.sum() < LEAST_ROWS:
            continue
        size, phantom = (getattr(source, name)[fair] for source in (speckle, reference))
        off = float(np.median(np.abs(np.log(size / phantom))))
        if off > least:
            evidence = (
                f"expected {name.removesuffix('_mm')} speckle of {np.median(phantom):.3f} mm, as in the "
                f"curves' phantom, got {np.median(size):.3f} mm ({100 * off:.0f} % off at "
                "the median depth)"
            )
            doubts.append(Doubt("curves", "another probe, depth or sampling rate", evidence, off > most))
    return tuple(doubts)


def doubt_sign(texture: Texture) -> Doubt | None:
    """Doubt the sign of Q where the echoes' frequency seems to rise with depth.

    Tissue takes more of high frequencies, so it falls; with the other sign it is mirrored at the demodulation
    frequency. Noise, too, draws it to the band's middle, so it is doubted only where it goes away from it.
    """
    signal, spectra = texture.signal, texture.spectra()
    if (
        spectra is None
        or spectra.depth_mm.size < LEAST_ROWS
        or not isinstance(signal, RFSettings)
        or not signal.demodulation_frequency_hz
    ):
        return None
    low, high = signal.bandwidth_hz
    frequency = spectra.power @ spectra.frequency_hz / spectra.power.sum(axis=1)
    slope, start = np.polyfit(np.arange(frequency.size), frequency - (low + high) / 2, 1)
    end = start + slope * (frequency.size - 1)
    if end - start <= _LEAST_RISE * (high - low) or abs(end) <= abs(start):
        return None
    evidence = (
        "expected echoes whose frequency falls with depth, as tissue attenuates it, got "
        f"{frequency[0] / 1e6:.2f} to {frequency[-1] / 1e6:.2f} MHz"
    )
    return Doubt("images", "sign of Q", evidence, False)
