"""Everything that placing a frame needs loaded before the first one comes: kernels take seconds to load."""

from __future__ import annotations

import numpy as np

from speckle3d.config import Config
from speckle3d.core.arrays import FloatArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import MismatchError
from speckle3d.core.sweep import BModeSettings, ImageGrid, RFSettings, Sweep
from speckle3d.live.tracking import ANEW, EVERY, LiveTracker
from speckle3d.live.volume import GrowingVolume

_WIDE_MM, _DEEP_MM = 12.0, 12.0
_KEPT = 0.97
"""Correlation of the amplitude from frame to frame."""
_BMODE_SPACING_MM = 0.1


def warm_up(curves: DecorrelationCurves, config: Config) -> None:
    """Track and compound a few small frames of made-up speckle, of the kind that the curves are of."""
    signal, pitch_mm = curves.key.signal, curves.key.vector_pitch_mm
    spacing_mm = signal.sample_spacing_mm if isinstance(signal, RFSettings) else _BMODE_SPACING_MM
    depth_mm = float(curves.depth_mm[0]) + _DEEP_MM
    grid = ImageGrid(round(_WIDE_MM / pitch_mm), round(depth_mm / spacing_mm), pitch_mm, spacing_mm)
    kind = np.int16 if isinstance(signal, RFSettings) else np.uint8
    black = np.zeros((1, grid.vectors, grid.samples), kind)
    example = Sweep(black, grid, signal, np.zeros(1), name="warming up", probe=curves.key.probe)
    rng, field = np.random.default_rng(0), None
    try:
        tracker = LiveTracker(example, curves, config, background=False)
    except MismatchError:
        # Curves that ask for more than these small images: what comes will do the loading.
        return
    volume = GrowingVolume(tracker.image_grid)
    with tracker:
        tracker.images = volume.keep
        for k in range(max(ANEW, EVERY) + 4):
            new = _speckle(grid, signal, rng)
            field = new if field is None else _KEPT * field + np.sqrt(1 - _KEPT**2) * new
            tracker.append(_stored(field, signal).astype(kind), float(k))
        volume.compounded(tracker.poses)


def _speckle(grid: ImageGrid, signal: RFSettings | BModeSettings, rng: np.random.Generator) -> FloatArray:
    """Noise as broad as a pulse and a beam are, shape (2, vector, sample): echo and its quadrature."""
    spectrum = np.fft.rfft(rng.normal(size=(grid.vectors, grid.samples)))
    if isinstance(signal, RFSettings):
        frequency = np.fft.rfftfreq(grid.samples, 1 / signal.sampling_rate_hz)
        low, high = signal.bandwidth_hz
        spectrum[:, (frequency < low) | (frequency > high)] = 0
    field = np.fft.irfft(spectrum, grid.samples)
    return np.asarray((field + np.roll(field, 1, axis=0)) / field.std())


def _stored(field: FloatArray, signal: RFSettings | BModeSettings) -> FloatArray:
    """Samples as a scanner stores them: counts, or grey levels of a rectified field."""
    if isinstance(signal, RFSettings):
        return np.asarray(np.rint(2000 * field))
    decibel = 20 * np.log10(np.maximum(np.abs(field), 1e-3))
    level = 1 + (decibel - 12) / signal.dynamic_range_db
    return np.asarray(np.rint(signal.full_scale * np.clip(level, 0, 1)))
