"""What a recording and its curves say before any pair is matched: keys, depths, band, gain, sign of Q."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from scipy.signal import welch

from speckle3d.core.curves import DecorrelationCurves, curve_widths
from speckle3d.core.doubts import Doubt
from speckle3d.core.errors import MismatchError, Speckle3DError
from speckle3d.core.sweep import BModeSettings, RFSettings, Sweep, read_frame
from speckle3d.matching.intensity import two_way_wavenumber
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.patches import PatchGrid
from speckle3d.matching.texture import spread_frames

SPECTRA, VECTORS = 3, 16
"""Frames looked at, evenly spread over the sweep, and vectors of each whose spectra are taken at least."""
WIDEST_MM = 8.0
"""Distance over which no beam keeps 0.6 of its correlation: that of an unfocused element 35 mm high, which
keeps (1 - d / 35)^2 of the echo's. Probes' elements are 2 to 15 mm high, and focused."""
TILT_FACTOR = 1.4
"""Of tilt's spread over that of the curves' width, from which it is calculated when curves are measured."""
MOST_WHITE = 0.01
"""Share of full white that is doubted: with 2.9 % a simulated sweep read 5 % longer than with none."""
_SEGMENT = 1024
"""Samples of a transform: 65 kHz apart at 66.7 MHz."""
_NOISE_QUANTILE = 0.2
_LEAST_ECHO = 0.05


def examine_recording(sweep: Sweep, matcher: FrameMatcher, curves: DecorrelationCurves) -> tuple[Doubt, ...]:
    """Hold a sweep's samples and its curves against what is claimed of them.

    Raises
    ------
    MismatchError
        If the curves are no beam's, or the echoes not of the band or the sampling rate that is claimed.
    """
    doubts = (
        *doubt_widths(curves),
        doubt_depths(curves, matcher.laid, matcher.patches),
        doubt_band(sweep),
        doubt_white(sweep),
    )
    return unrefuted(doubts, sweep.name, MismatchError)


def doubt_depths(curves: DecorrelationCurves, laid: PatchGrid, used: PatchGrid) -> Doubt | None:
    """Tell that patches were left out because the curves did not measure their depths."""
    rows, kept = laid.row_depth_mm, used.row_depth_mm
    if rows.size == kept.size:
        return None
    evidence = (
        f"expected patches at the curves' depths of {curves.depth_mm[0]:.1f} to {curves.depth_mm[-1]:.1f} "
        f"mm, got {rows[0]:.1f} to {rows[-1]:.1f} mm: {rows.size - kept.size} of {rows.size} rows left out"
    )
    return Doubt("curves", "depths", evidence, False)


def doubt_widths(curves: DecorrelationCurves) -> Iterator[Doubt]:
    """Doubt curves that no beam has."""
    width = curve_widths(curves.distance_mm, curves.correlation)
    if curves.tilt is not None and isinstance(curves.key.signal, RFSettings):
        ratio = float(np.median(curves.tilt.spread_mm / (two_way_wavenumber(curves.key.signal) * width**2)))
        if abs(np.log(ratio)) > np.log(TILT_FACTOR):
            evidence = f"expected tilt to spread echoes as the curves' width has it, got {ratio:.2f} times it"
            yield Doubt("curves", "distances changed after the curves were measured", evidence, True)
    if np.median(width) > WIDEST_MM:
        evidence = f"expected correlation to fall within {WIDEST_MM:g} mm, got {np.median(width):.3g} mm"
        yield Doubt("curves", "units", evidence, True)


def doubt_band(sweep: Sweep) -> Doubt | None:
    """Doubt a sampling rate or a band that the echoes contradict.

    Tissue takes high frequencies away and adds none, so most of the echo above the noise cannot lie above the
    band; below it lies what attenuation or a harmonic leaves, which is no contradiction.
    """
    signal = sweep.signal
    if not isinstance(signal, RFSettings):
        return None
    (low, high), samples = signal.bandwidth_hz, min(sweep.grid.samples, _SEGMENT)
    each = max(1, sweep.grid.vectors // VECTORS)
    chosen = [read_frame(sweep.frames, k)[::each] for k in spread_frames(len(sweep), SPECTRA)]
    some = np.nan_to_num(np.concatenate(chosen), posinf=0.0, neginf=0.0)  # such frames are flagged
    _, power = welch(some, nperseg=samples, return_onesided=False, detrend=False)
    # Mains, gain control and steps between samples are below.
    frequency = signal.bin_frequency_hz(samples)
    rising = np.argsort(frequency)
    rising = rising[frequency[rising] >= low / 4]
    frequency, power = frequency[rising], power.mean(axis=0)[rising]
    echo = np.maximum(power - 2 * np.quantile(power, _NOISE_QUANTILE), 0.0)
    if echo.sum() <= _LEAST_ECHO * power.sum():
        return None
    middle = float(np.interp(0.5, np.cumsum(echo) / echo.sum(), frequency))
    inside = float(echo[(frequency >= low) & (frequency <= high)].sum() / echo.sum())
    if middle <= high and (middle >= low or inside > _LEAST_ECHO):
        return None
    evidence = (
        f"expected echoes of {low / 1e6:.3g} to {high / 1e6:.3g} MHz, got {100 * inside:.0f} % of their "
        f"power there and half of it {'above' if middle > high else 'below'} {middle / 1e6:.3g} MHz"
    )
    return Doubt("images", "sampling rate or band", evidence, middle > high)


def doubt_white(sweep: Sweep) -> Doubt | None:
    """Doubt the gain of B-mode images in which bright speckle is cut off at full white.

    What is cut off decorrelates otherwise than in the phantom's images.
    """
    signal = sweep.signal
    if not isinstance(signal, BModeSettings):
        return None
    some = np.stack([read_frame(sweep.frames, k) for k in spread_frames(len(sweep), SPECTRA)])
    share = float((some >= signal.full_scale).sum()) / max(int((some > 0).sum()), 1)
    if share <= MOST_WHITE:
        return None
    evidence = f"expected at most {MOST_WHITE:.0%} of what is not black at full white, got {share:.1%}"
    return Doubt("images", "gain", evidence, False)


def unrefuted(doubts: Iterable[Doubt | None], where: str, error: type[Speckle3DError]) -> tuple[Doubt, ...]:
    """Return doubts that leave what is doubted usable; raise `error` with the first that does not."""
    found = tuple(doubt for doubt in doubts if doubt is not None)
    for doubt in found:
        if doubt.refuted:
            raise error(f"{where}: {doubt}")
    return found
