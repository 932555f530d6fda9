"""Speckle's size by depth and the echo's spectrum, from some frames: marks of a probe and its settings.

The size of speckle along the vectors is the pulse's, across them the aperture's over depth; neither depends
on what is scanned as long as it scatters as a phantom does; patches whose contrast denies that do not count.
"""

from __future__ import annotations

import numpy as np
from scipy import fft

from speckle3d.core.arrays import ComplexArray, Float32Array, FloatArray, IntArray
from speckle3d.core.curves import SpeckleSize
from speckle3d.core.doubts import Doubt
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import BModeSettings, RFSettings, Sweep
from speckle3d.matching.blocks import ImageSink
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.patches import PatchGrid

FRAMES, SPECTRA = 12, 3
"""Frames looked at for speckle and for the spectrum, evenly spread over the sweep."""
CONTRAST = (0.75, 1.15)
"""Standard deviation over mean of intensity in patches that count: 1 for speckle, scattered by its 50 to 90
cells. Coherent structure is above; its patches look coarser than speckle."""
LEAST_PATCHES = 8
"""Patches, over all frames, that a row's size is taken from at least."""
_NOISE_QUANTILE = 0.2
_MOST_WHITE = 0.01
"""Share of full white that is doubted: with 2.9 % a simulated sweep read 5 % longer than with none."""
_DEPTHS, _LEAST_RISE, _LEAST_COHERENCE = 12, 0.04, 0.1
"""Parts of the depth in which frequency is looked at; its rise, over the bandwidth, that is doubted (over
simulated tissue of 0.5 dB/cm/MHz it falls by 0.14 in 4 cm); coherence below which it is not known."""
_LEAST_ECHO = 0.05


class SpeckleSizes:
    """Speckle's sizes in the frames that are looked at if none is left out, kept as the sweep is matched.

    Parameters
    ----------
    then : callable, optional
        To which every image is passed on.
    """

    def __init__(self, sweep: Sweep, matcher: FrameMatcher, then: ImageSink | None = None) -> None:
        self._wanted, self._patches, self._then = (
            _spread(np.arange(len(sweep)), FRAMES),
            matcher.patches,
            then,
        )
        self.by_frame: dict[int, FloatArray] = {}

    def keep(self, frame: int, intensity: Float32Array) -> None:
        """Take the intensity image of one frame."""
        if frame in self._wanted:
            self.by_frame[frame] = _sizes(intensity, self._patches)
        if self._then:
            self._then(frame, intensity)


def speckle_size(
    sweep: Sweep, matcher: FrameMatcher, among: IntArray | None = None, known: SpeckleSizes | None = None
) -> SpeckleSize:
    """Measure lateral and axial speckle size in each row of the patches that are matched.

    Parameters
    ----------
    among : ndarray of int, optional
        Frames to choose from; by default all.
    known : SpeckleSizes, optional
        Of frames that need not be read anew.

    Returns
    -------
    SpeckleSize
        Of shape (r,); NaN where too few patches hold fully developed speckle.
    """
    frames = _spread(np.arange(len(sweep)) if among is None else among, FRAMES)
    found = dict(known.by_frame) if known else {}
    for k in frames:
        if k not in found:
            found[k] = _sizes(matcher.echo(sweep.frames[k]).intensity, matcher.patches)
    sizes = matcher.patches.rows_of(np.stack([found[k] for k in frames]))
    lateral, axial = sizes.transpose(1, 2, 0, 3).reshape(*sizes.shape[1:3], -1)
    return SpeckleSize(_medians(lateral), _medians(axial))


def echo_spectra(sweep: Sweep, depth_mm: FloatArray, height_mm: float) -> tuple[FloatArray, FloatArray]:
    """Power spectrum of the echoes about some depths, noise taken off, over some frames.

    Parameters
    ----------
    depth_mm : ndarray, shape (y,)
    height_mm : float
        Height of the window about each depth.

    Returns
    -------
    frequency_hz : ndarray, shape (f,)
    power : ndarray, shape (y, f)

    Raises
    ------
    InvalidInputError
        If the sweep holds B-mode images, which have no spectrum, or the depths are not in them.
    """
    signal, grid = sweep.signal, sweep.grid
    if not isinstance(signal, RFSettings):
        raise InvalidInputError(f"{sweep.name}: expected RF, whose spectrum can be seen, got B-mode images")
    count = min(round(height_mm / grid.sample_spacing_mm), grid.samples)
    middle = np.rint((depth_mm - grid.first_sample_depth_mm) / grid.sample_spacing_mm).astype(int)
    first = np.clip(middle - count // 2, 0, grid.samples - count)
    if count < 16 or (np.abs(first + count // 2 - middle) > count).any():
        raise InvalidInputError(
            f"{sweep.name}: expected echoes from {depth_mm[0]:.1f} to {depth_mm[-1]:.1f} mm, got images of "
            f"{grid.depth_mm:.1f} mm"
        )
    frequency_hz, bins = _bins(signal, count)
    window = np.hanning(count).astype(np.float32)
    power = np.zeros((depth_mm.size, bins.size))
    for k in _spread(np.arange(len(sweep)), FRAMES):
        frame = sweep.frames[k]
        for row, start in enumerate(first):
            spectrum = np.fft.fft(frame[:, start : start + count] * window, axis=1)[:, bins]
            # Bright structure counts no more than speckle: images are equalised before they are correlated.
            energy = np.abs(spectrum) ** 2
            power[row] += (energy / np.maximum(energy.sum(axis=1, keepdims=True), 1e-30)).mean(axis=0)
    # I/Q hold little beside the band, and nothing where their filter has cut them off.
    quantile = 0.0 if signal.are_complex else _NOISE_QUANTILE
    noise = np.quantile(power, quantile, axis=1, keepdims=True)
    return frequency_hz, np.maximum(power - noise, 1e-12 * power.max())


def doubt_images(sweep: Sweep) -> tuple[Doubt, ...]:
    """What a sweep's samples say against what is claimed of them."""
    return (*doubt_band(sweep), *doubt_sign(sweep), *doubt_white(sweep))


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
    echo = np.maximum(power - 2 * np.quantile(power, _NOISE_QUANTILE), 0.0)
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
    some = [sweep.frames[k] for k in _spread(np.arange(len(sweep)), SPECTRA)]
    seen = sum(int(np.count_nonzero(frame)) for frame in some)
    share = sum(int((frame >= signal.full_scale).sum()) for frame in some) / max(seen, 1)
    if share <= _MOST_WHITE:
        return ()
    return (
        Doubt(
            "images",
            "gain",
            f"expected at most {100 * _MOST_WHITE:.0f} % of what is not black at full white, got "
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
    for k in _spread(np.arange(len(sweep)), SPECTRA):
        parts = np.array_split(sweep.frames[k].astype(np.complex128), _DEPTHS, axis=1)
        # Over the energy of each vector: bright structure counts no more than speckle.
        turns.append([_coherence(part).mean() for part in parts])
    return np.asarray(np.mean(turns, axis=0))


def _coherence(part: ComplexArray) -> ComplexArray:
    energy = (np.abs(part) ** 2).sum(axis=1)
    return np.asarray((np.conj(part[:, :-1]) * part[:, 1:]).sum(axis=1) / np.maximum(energy, 1e-30))


def _spread(frames: IntArray, count: int) -> list[int]:
    """At most so many of some frames, evenly spread."""
    at = np.unique(np.linspace(0, frames.size - 1, count).round().astype(int))
    return [int(k) for k in frames[at]]


def _medians(rows: FloatArray) -> FloatArray:
    """Median of each row's finite values; NaN where they are few."""
    known = [row[np.isfinite(row)] for row in rows]
    return np.array([np.median(row) if row.size >= LEAST_PATCHES else np.nan for row in known])


def _sizes(intensity: Float32Array, patches: PatchGrid) -> FloatArray:
    """Lateral and axial size of each patch's speckle, mm, shape (2, p); NaN unless it is fully developed."""
    (wide, high), first = patches.size, patches.first
    tiles = np.stack([intensity[v : v + wide, d : d + high] for v, d in first]).astype(float)
    with np.errstate(all="ignore"):  # Flat patches come out as NaN.
        varying = tiles / tiles.mean(axis=(1, 2), keepdims=True) - 1.0
        contrast = np.sqrt(_mean_product(varying, varying))
        lags = (varying[:, :-1], varying[:, 1:]), (varying[..., :-1], varying[..., 1:])
        rho = np.stack([_mean_product(a, b) / contrast**2 for a, b in lags])
        # The width of a Gaussian with this correlation one sample off.
        size = patches.spacing_mm[:, None] / np.sqrt(-2.0 * np.log(np.clip(rho, 1e-3, 0.999)))
        fair = (contrast > CONTRAST[0]) & (contrast < CONTRAST[1])
    return np.where(fair & np.isfinite(rho), size, np.nan)


def _mean_product(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("pvs,pvs->p", a, b) / (a.shape[1] * a.shape[2]))


def _bins(signal: RFSettings, count: int) -> tuple[FloatArray, IntArray]:
    """Frequencies above zero that `count` samples hold, increasing, and their bins in ``fft``."""
    frequency_hz = signal.bin_frequency_hz(count)[: None if signal.are_complex else count // 2]
    rising = np.argsort(frequency_hz)
    rising = rising[frequency_hz[rising] >= 0]
    return frequency_hz[rising], rising


def _spectrum(sweep: Sweep, signal: RFSettings) -> tuple[FloatArray, FloatArray]:
    """Power by frequency, over all vectors of some frames."""
    # A few samples less make a transform of small factors several times as fast.
    samples = fft.prev_fast_len(sweep.grid.samples, not signal.are_complex)
    frequency_hz, bins = _bins(signal, samples)
    window = np.hanning(samples).astype(np.float32)
    total = np.zeros(bins.size)
    for k in _spread(np.arange(len(sweep)), SPECTRA):
        frame = sweep.frames[k][:, :samples] * window
        spectrum = (fft.fft(frame, axis=1) if signal.are_complex else fft.rfft(frame, axis=1))[:, bins]
        total = total + (spectrum.real**2 + spectrum.imag**2).mean(axis=0)
    return frequency_hz, total
