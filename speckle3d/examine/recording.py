"""What a recording and its curves say before any pair is matched: keys, depths, band, gain, sign of Q."""

from __future__ import annotations

import numpy as np
from scipy import fft

from speckle3d.core.arrays import ComplexArray, FloatArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.doubts import Doubt, unrefuted
from speckle3d.core.errors import MismatchError
from speckle3d.core.sweep import BModeSettings, RFSettings, Sweep
from speckle3d.matching.intensity import two_way_wavenumber
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.patches import PatchGrid
from speckle3d.matching.texture import NOISE_QUANTILE, spectrum_bins, spread_frames

SPECTRA = 3
"""Frames looked at, evenly spread over the sweep."""
WIDEST_MM = 8.0
"""Distance over which no beam keeps half of its correlation: that of an unfocused element 25 mm high, which
keeps (1 - d / 25)^2 of the echo's. Probes' elements are 2 to 15 mm high, and focused."""
TILT_FACTOR = 1.4
"""Of tilt's spread over that of the curves' width, from which it is calculated when curves are measured."""
MOST_WHITE = 0.01
"""Share of full white that is doubted: with 2.9 % a simulated sweep read 5 % longer than with none."""
_DEPTHS, _LEAST_RISE, _LEAST_COHERENCE = 12, 0.04, 0.1
"""Parts of the depth in which frequency is looked at; its rise, over the bandwidth, that is doubted (over
simulated tissue of 0.5 dB/cm/MHz it falls by 0.14 in 4 cm); coherence below which it is not known."""
_LEAST_ECHO = 0.05


def examine_recording(sweep: Sweep, matcher: FrameMatcher, curves: DecorrelationCurves) -> tuple[Doubt, ...]:
    """Hold a sweep's samples and its curves against what is claimed of them.

    Raises
    ------
    MismatchError
        If the curves are no beam's, or the echoes not of the band or the sampling rate that is claimed.
    """
    doubts = [
        *doubt_widths(curves),
        *doubt_depths(curves, matcher.laid, matcher.patches),
        *doubt_band(sweep),
        *doubt_sign(sweep),
        *doubt_white(sweep),
    ]
    return unrefuted(doubts, sweep.name, MismatchError)


def doubt_depths(curves: DecorrelationCurves, laid: PatchGrid, used: PatchGrid) -> tuple[Doubt, ...]:
    """Tell that patches were left out because the curves did not measure their depths."""
    rows, kept = laid.row_depth_mm, used.row_depth_mm
    if rows.size == kept.size:
        return ()
    return (
        Doubt(
            "curves",
            "depths",
            f"expected patches at the curves' depths of {curves.depth_mm[0]:.1f} to "
            f"{curves.depth_mm[-1]:.1f} mm, got {rows[0]:.1f} to {rows[-1]:.1f} mm: "
            f"{rows.size - kept.size} of {rows.size} rows left out",
            refuted=False,
        ),
    )


def doubt_widths(curves: DecorrelationCurves) -> tuple[Doubt, ...]:
    """Doubt curves that no beam has."""
    half = np.array([np.interp(-0.5, -row, curves.distance_mm) for row in curves.correlation])
    found = []
    if curves.tilt is not None and isinstance(curves.key.signal, RFSettings):
        width = np.array([np.interp(0.5, -np.log(row), curves.distance_mm) for row in curves.correlation])
        ratio = float(np.median(curves.tilt.spread_mm / (two_way_wavenumber(curves.key.signal) * width**2)))
        if abs(np.log(ratio)) > np.log(TILT_FACTOR):
            found.append(
                Doubt(
                    "curves",
                    "distances changed after the curves were measured",
                    f"expected tilt to spread echoes as the curves' width has it, got {ratio:.2f} times that",
                    refuted=True,
                )
            )
    if np.median(half) > WIDEST_MM:
        found.append(
            Doubt(
                "curves",
                "units",
                f"expected correlation to halve within {WIDEST_MM:g} mm, got {np.median(half):.3g} mm",
                refuted=True,
            )
        )
    return tuple(found)


def doubt_band(sweep: Sweep) -> tuple[Doubt, ...]:
    """Doubt a sampling rate or a band that the echoes contradict.

    Tissue takes high frequencies away and adds none, so most of the echo above the noise cannot lie above the
    band; below it lies what attenuation or a harmonic leaves, which is no contradiction.
    """
    signal = sweep.signal
    if not isinstance(signal, RFSettings):
        return ()
    low, high = signal.bandwidth_hz
    frequency, power = _spectrum(sweep, signal)
    # Mains, gain control and steps between samples are below.
    frequency, power = frequency[frequency >= low / 4], power[frequency >= low / 4]
    echo = np.maximum(power - 2 * np.quantile(power, NOISE_QUANTILE), 0.0)
    if echo.sum() < _LEAST_ECHO * power.sum():
        return ()
    middle = float(np.interp(0.5, np.cumsum(echo) / echo.sum(), frequency))
    inside = float(echo[(frequency >= low) & (frequency <= high)].sum() / echo.sum())
    if middle <= high and (middle >= low or inside > _LEAST_ECHO):
        return ()
    return (
        Doubt(
            "images",
            "sampling rate or band",
            f"expected echoes of {low / 1e6:.3g} to {high / 1e6:.3g} MHz, got {100 * inside:.0f} % of their "
            f"power there and half of it {'above' if middle > high else 'below'} {middle / 1e6:.3g} MHz",
            refuted=middle > high,
        ),
    )


def doubt_white(sweep: Sweep) -> tuple[Doubt, ...]:
    """Doubt the gain of B-mode images in which bright speckle is cut off at full white.

    What is cut off decorrelates otherwise than in the phantom's images.
    """
    signal = sweep.signal
    if not isinstance(signal, BModeSettings):
        return ()
    some = [sweep.frames[k] for k in spread_frames(len(sweep), SPECTRA)]
    seen = sum(int(np.count_nonzero(frame)) for frame in some)
    share = sum(int((frame >= signal.full_scale).sum()) for frame in some) / max(seen, 1)
    if share <= MOST_WHITE:
        return ()
    return (
        Doubt(
            "images",
            "gain",
            f"expected at most {100 * MOST_WHITE:.0f} % of what is not black at full white, got "
            f"{100 * share:.1f} %",
            refuted=False,
        ),
    )


def doubt_sign(sweep: Sweep) -> tuple[Doubt, ...]:
    """Doubt the sign of Q where the echoes' frequency seems to rise with depth.

    Tissue takes more of high frequencies, so it falls; with the other sign it is mirrored at the demodulation
    frequency. Noise, too, draws it towards that, so it is doubted only where it goes away from it.
    """
    signal = sweep.signal
    if not isinstance(signal, RFSettings) or not signal.demodulation_frequency_hz:
        return ()
    turns = _turns_by_depth(sweep)[1:]
    if np.abs(turns).min() < _LEAST_COHERENCE:
        return ()
    shift_hz = np.angle(turns) * signal.sampling_rate_hz / (2.0 * np.pi)
    slope, start = np.polyfit(np.arange(shift_hz.size), shift_hz, 1)
    end = start + slope * (shift_hz.size - 1)
    low, high = signal.bandwidth_hz
    if end - start <= _LEAST_RISE * (high - low) or abs(end) <= abs(start):
        return ()
    middle = signal.demodulation_frequency_hz
    return (
        Doubt(
            "images",
            "sign of Q",
            "expected echoes whose frequency falls with depth, as tissue attenuates it, got "
            f"{(middle + start) / 1e6:.2f} to {(middle + end) / 1e6:.2f} MHz",
            refuted=False,
        ),
    )


def _turns_by_depth(sweep: Sweep) -> ComplexArray:
    """Coherence of neighbouring samples in equal parts of the depth; its phase is the mean frequency [1]_.

    References
    ----------
    .. [1] C. Kasai et al., "Real-time two-dimensional blood flow imaging using an autocorrelation
       technique", IEEE Trans. Sonics Ultrason. 32, 1985.
    """
    turns = []
    for k in spread_frames(len(sweep), SPECTRA):
        parts = np.array_split(sweep.frames[k].astype(np.complex128), _DEPTHS, axis=1)
        # Over the energy of each vector: bright structure counts no more than speckle.
        turns.append([_coherence(part).mean() for part in parts])
    return np.asarray(np.mean(turns, axis=0))


def _coherence(part: ComplexArray) -> ComplexArray:
    energy = (np.abs(part) ** 2).sum(axis=1)
    return np.asarray((np.conj(part[:, :-1]) * part[:, 1:]).sum(axis=1) / np.maximum(energy, 1e-30))


def _spectrum(sweep: Sweep, signal: RFSettings) -> tuple[FloatArray, FloatArray]:
    """Power by frequency, over all vectors of some frames."""
    # A few samples less make a transform of small factors several times as fast.
    samples = fft.prev_fast_len(sweep.grid.samples, not signal.are_complex)
    frequency_hz, bins = spectrum_bins(signal, samples)
    window = np.hanning(samples).astype(np.float32)
    total = np.zeros(bins.size)
    for k in spread_frames(len(sweep), SPECTRA):
        frame = sweep.frames[k][:, :samples] * window
        spectrum = (fft.fft(frame, axis=1) if signal.are_complex else fft.rfft(frame, axis=1))[:, bins]
        total = total + (spectrum.real**2 + spectrum.imag**2).mean(axis=0)
    return frequency_hz, total
