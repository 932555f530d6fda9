"""Decorrelation curves corrected by sweeps of known length (tracker or crossing sweep).

A tracker's jitter is a good part of the steps between frames, and smoothing it away takes the hand's pauses
and tremor with it: curves fitted to smoothed positions come out 8 % too narrow. The images' own steps are far
steadier but for a common factor. So the sweep is read with curves that are roughly right, and these are
corrected until the images' length is the tracker's, over which jitter counts once and not at every step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from speckle3d.config import Config
from speckle3d.core.curves import ATTENUATION_SIGMA, DecorrelationCurves, curve_widths
from speckle3d.core.errors import InsufficientDataError, MismatchError, Speckle3DError
from speckle3d.core.leastsquares import robust_sigma
from speckle3d.core.progress import Progress
from speckle3d.core.sweep import Sweep
from speckle3d.motion.lens import stretched
from speckle3d.phantom_curves import calibrate_curves
from speckle3d.tracked import Tracked
from speckle3d.tracking import track

LENGTH_SIGMA = 0.005
"""Of a tracker's millimetres and of how well its mounting is known, beside its jitter."""
ALIKE_FRAMES, ALIKE_MM = 10, 1.0
"""Frames, or travel if that is less, over which the images' departure from the tracker stays the same. Errors
over claims (simulated straight lines of 10 to 100 frames, rms): 0.2 to 0.7 with jitter that is new in every
frame, 0.5 to 2.1 with jitter over 3 to 30 frames; if its new part counts once a frame, up to 2.7."""
LEAST_FRAMES = 8
"""Frames with readings from which a length and its error are estimated."""
LEAST_SURE = 0.3
"""Relative standard deviation of length beyond which it corrects nothing; up to it the curves claim it."""
STEADY_MM = 0.01
"""Jitter up to which positions are a stage's, exact enough for each step; trackers have 0.05 to 0.3."""
ROUNDS = 2


def tracked_curves(
    sweeps: Sequence[Sweep],
    start: DecorrelationCurves | None = None,
    config: Config | None = None,
    progress: Progress | None = None,
) -> DecorrelationCurves:
    """Measure decorrelation curves on sweeps by hand whose tracker is calibrated to the image.

    Parameters
    ----------
    sweeps : sequence of Sweep
        Over a phantom; with `start`, over tissue, too.
    start : DecorrelationCurves, optional
        Curves that are roughly right, from a data sheet or another probe; by default fitted to the tracker's
        smoothed positions, for which everything scanned must scatter as a phantom does.
    config : Config, optional
    progress : callable, optional
        Called with frames done and frames in all, for each sweep and round.

    Raises
    ------
    InsufficientDataError
        If a sweep has no tracker, or is too short for its jitter.
    """
    settings = config or Config()
    bare = [replace(sweep, truth=None) for sweep in sweeps]
    if start is None:
        return _fit_length(bare, calibrate_curves(bare, settings, progress), settings, progress)
    if start.key.correlation_of == "echo":
        return _fit_length(bare, start, settings, progress)
    # Of images without phase structure cannot be told from speckle: it goes into the curves. A path that is
    # read without adapting to it may fold back, one that is adapted to what is no speckle bends depths.
    candidates: list[DecorrelationCurves] = []
    reason: Speckle3DError = InsufficientDataError("expected sweeps, got none")
    for adapt in (True, False):
        try:
            curves = _fit_length(bare, start, settings, progress, 1) if adapt else start
            tissue = replace(curves, of_tissue=True)
            candidates.append(_fit_length(bare, tissue, settings, progress))
        except (InsufficientDataError, MismatchError) as error:
            reason = error
    if not candidates:
        raise reason
    return min(candidates, key=lambda curves: curves.scale_sigma)


def _fit_length(
    sweeps: Sequence[Sweep],
    curves: DecorrelationCurves,
    config: Config,
    progress: Progress | None,
    rounds: int = ROUNDS,
) -> DecorrelationCurves:
    """Curves scaled until the images' lengths of some sweeps equal the tracker's."""
    for _ in range(rounds):
        results = [track(sweep, curves, config, progress) for sweep in sweeps]
        lengths = [tracker_scale(sweep, result) for sweep, result in zip(sweeps, results, strict=True)]
        curves = corrected_curves(curves, [result.curves for result in results], lengths)
    return replace(curves, origin="tracked")


def jitters(sweep: Sweep) -> bool:
    """Whether positions come from a noisy tracker, not from the truth or a stage."""
    tracker = sweep.tracker
    if sweep.truth is not None or tracker is None or len(tracker.readings.time_s) < 3:
        return False
    if tracker.sensor_from_image is None:
        raise InsufficientDataError(tracker.uncalibrated)
    # Of its readings: frames lie on lines between those of a slow one.
    poses = tracker.readings.world_from_sensor * tracker.sensor_from_image
    z = (poses[0].inv() * poses).apply(sweep.grid.centre_mm)[:, 2]
    # Of second differences, which smooth motion hardly has.
    return bool(robust_sigma(z[2:] - 2.0 * z[1:-1] + z[:-2]) > np.sqrt(6.0) * STEADY_MM)


def tracker_scale(sweep: Sweep, result: Tracked) -> Length:
    """Tracker's elevational length over the images'.

    Raises
    ------
    InsufficientDataError
        If the sweep has no tracker for most of its frames, or its jitter hides the length.
    """
    tracker = sweep.tracker
    if tracker is None or tracker.sensor_from_image is None:
        raise InsufficientDataError(
            f"{sweep.name}: expected a tracker that is calibrated to the image, got none: "
            "speckle3d calibrate images or plane tells how it sits on the probe"
        )
    valid = tracker.covers(sweep.frame_time_s) & (result.flags == 0)
    if valid.sum() < LEAST_FRAMES:
        raise InsufficientDataError(
            f"{sweep.name}: expected {LEAST_FRAMES} frames with tracker readings, got {valid.sum()}"
        )
    poses = tracker.world_from_image(sweep.frame_time_s[valid])
    middle = len(poses) // 2
    z = (poses[middle].inv() * poses).apply(sweep.grid.centre_mm)[:, 2]
    images = result.image[valid]
    x = (images[middle].inv() * images).apply(sweep.grid.centre_mm)[:, 2]
    z, x = z - z.mean(), x - x.mean()
    scale = abs(float(z @ x)) / float(x @ x)
    residuals = z - np.sign(z @ x) * scale * x
    variance = float(residuals @ residuals) / (z.size - 2)
    alike = float(np.clip(ALIKE_MM * z.size / np.ptp(z), 1.0, min(ALIKE_FRAMES, z.size)))
    sigma = float(np.hypot(np.sqrt(alike * variance / (x @ x)) / scale, LENGTH_SIGMA))
    if not sigma < LEAST_SURE:
        raise InsufficientDataError(
            f"{sweep.name}: expected a length that the tracker knows to {100 * LEAST_SURE:g} %, got "
            f"{np.ptp(z):.1f} mm to {100 * sigma:.1f} %: a longer sweep would help"
        )
    return Length(float(np.log(scale)), sigma)


class Length(NamedTuple):
    """Logarithm of a sweep's true elevational length over the images', and its standard deviation."""

    log_scale: float
    sigma: float


def corrected_curves(
    curves: DecorrelationCurves, read_with: Sequence[DecorrelationCurves], lengths: Sequence[Length]
) -> DecorrelationCurves:
    """Correct the curves of a probe by sweeps whose true length is known from a crossing or a tracker.

    All distances are multiplied by one factor; where the sweeps were read with another lens than `curves`
    have, its factors by depth go before it. Tissue whose structure reads short is corrected with it: curves
    learnt over tissue are right over tissue.

    Parameters
    ----------
    curves : DecorrelationCurves
    read_with : sequence of DecorrelationCurves
        With which each sweep was read in the end.
    lengths : sequence of Length

    Returns
    -------
    DecorrelationCurves
        Of origin "crossing"; their `scale_sigma` is that of the lengths and of tissue that attenuates
        otherwise.
    """
    scale, sigma = np.array(lengths).T
    information = sigma**-2.0
    weight = information / information.sum()
    widths = [np.log(curve_widths(c.distance_mm, c.correlation)) for c in (curves, *read_with)]
    lens = np.mean(widths[1:], axis=0) - widths[0]
    scatter = (weight * (scale - weight @ scale) ** 2).sum() / scale.size
    error = float(np.sqrt(scatter + 1.0 / information.sum() + ATTENUATION_SIGMA**2))
    # Widened for the attenuation of these sweeps, the curves go with a spectrum that has it.
    better = replace(stretched(curves, lens + weight @ scale), spectrum=read_with[0].spectrum)
    return replace(better, scale_sigma=error, origin="crossing")
