"""Load kernels before the first frame arrives."""

import numpy as np
from scipy.signal import lfilter

from speckle3d.config import Config
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import MismatchError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import RFSettings, Sweep
from speckle3d.live.tracking import ANEW, EVERY, LiveTracker
from speckle3d.live.volume import GrowingVolume

_WIDE_MM, _DEEP_MM = 12.0, 12.0
_CORRELATION = 0.97
"""Correlation of the amplitude from frame to frame."""
_BMODE_SPACING_MM = 0.1


def warm_up(curves: DecorrelationCurves, config: Config) -> None:
    """Track and compound a few small frames of made-up speckle, of the kind that the curves are of."""
    signal, pitch_mm = curves.key.signal, curves.key.vector_pitch_mm
    of_rf = isinstance(signal, RFSettings)
    spacing_mm = signal.sample_spacing_mm if isinstance(signal, RFSettings) else _BMODE_SPACING_MM
    depth_mm = float(curves.depth_mm[0]) + _DEEP_MM
    grid = ImageGrid(round(_WIDE_MM / pitch_mm), round(depth_mm / spacing_mm), pitch_mm, spacing_mm)
    noise = np.random.default_rng(0).normal(size=(max(ANEW, EVERY) + 4, grid.vectors, grid.samples))
    changing = lfilter([np.sqrt(1 - _CORRELATION**2)], [1, -_CORRELATION], noise, axis=0)
    field = changing + np.roll(changing, 1, axis=1)
    frames = (2000 * field).astype(np.int16) if of_rf else np.clip(128 + 40 * field, 0, 255).astype(np.uint8)
    times_s = np.arange(float(len(frames)))
    sweep = Sweep(frames, grid, signal, times_s, name="warming up", probe=curves.key.probe)
    try:
        tracker = LiveTracker(sweep, curves, config, background=False)
    except MismatchError:
        # Curves that ask for more than these small images: what comes will do the loading.
        return
    volume = GrowingVolume(tracker.image_grid)
    tracker.images = volume.keep
    for frame, time_s in zip(frames, sweep.frame_time_s.tolist(), strict=True):
        tracker.append(frame, time_s)
    volume.compound(tracker.poses)
