"""Clock offset between images and a tracker, from tissue that the probe passes twice, forward and back.

A wrong offset shifts all images of the way forward to one side and all of the way back to the other, so that
images of one way do not correlate with cuts of the other. Neither a phantom nor an accurate spatial
calibration is needed, since the motion is along one line.

Even noise correlates best at some delay, so each image votes with its own best delay, and most must agree.

References
----------
.. [1] W. Wein and A. Khamene, "Image-based method for in-vivo freehand ultrasound calibration", SPIE Medical
   Imaging 6920, 2008, section 3.3.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import RigidTransform

from calibration.clock.offset import SEARCH_S, ClockOffset, SmoothReadings, covered, delays_around, peak_of
from calibration.images.similarity import LEAST_OVERLAP, Comparison, spread_patches
from calibration.images.stacks import read_stack
from calibration.points import Recording
from calibration.settings import ImageFit
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.images import spread_frames
from speckle3d.core.progress import Progress

STEP_S = 0.01

LEAST_AGREEING = 0.5
"""Share of the compared images whose own best delay must be near the common one; the strength of speckle and
noise does not enter. It is 0.7 to 1 for simulated tissue and at least 0.56 under noise twice as strong as the
picture; up to 0.44 for noise, shuffled images, ones that never change and delays outside the range. It was
more for images reversed in time and ones 1.2 s late, in which no peak could be located."""

SIGMAS = 3.0
_WIDEST_S = 0.1
_BLOCK = 5
"""Neighbouring images that share frames of the other way."""

PIXEL_MM = 0.3
"""Pixel of the compared images: finer than the beam, since speckle, seen again on the way back, helps."""

COARSE, FINE = 8, 60
"""Images of each way compared to find the peak, and to locate it; the paper takes four. A tracker's jitter of
0.15 mm is 15 ms at 10 mm/s, and only many images average it out."""

_PLACES = 9
_LEAST_TRAVEL_MM = 2.0
"""About an elevational beam width: over less travel all images look alike."""

_FEWEST_FRAMES = 20


def delay_from_images(
    recording: Recording,
    sensor_from_image: RigidTransform,
    search_s: float = SEARCH_S,
    tracker_mm: float = ImageFit().tracker_mm,
    progress: Progress | None = None,
) -> ClockOffset:
    """Find the delay at which images of either way correlate best with cuts of the other.

    Parameters
    ----------
    recording : Recording
        A motion forward and back.
    sensor_from_image : RigidTransform
        A rough one is enough.
    search_s : float
        Delays within it of the recording's own are tried.
    tracker_mm : float
        What the tracker, or tissue that moved, displaces one way against the other by.

    Raises
    ------
    InsufficientDataError
        If the probe does not go forward and back, the images do not show where they were taken, the best
        delay is at the end of the range, or another is as good, as with a periodic motion.
    """
    around_s, readings, centre_mm = recording.time_offset_s, recording.readings, recording.grid.centre_mm
    frames = np.flatnonzero(covered(readings, recording.frame_time_s, around_s, search_s))
    times, steady = recording.frame_time_s[frames], SmoothReadings(readings)
    poses = steady.at(times - around_s) * sensor_from_image
    turn, share = _there_and_back(poses.apply(centre_mm))
    stack, numbers = read_stack(recording, PIXEL_MM)
    ways = [slice(0, turn + 1), slice(turn, None)]
    stacks = [stack[np.flatnonzero(np.isin(numbers, frames[way]))] for way in ways]
    steps_mm = np.linalg.norm(np.diff(poses.translation, axis=0), axis=1)
    gap_mm = 2.0 * max(1.0, 2.0 * float(np.percentile(steps_mm, 95)))
    doubts = (
        "images and readings do not belong together, or the delay lies outside the "
        f"{search_s:g} s searched: --search-s"
    )

    def correlations(number: int, delay_s: float) -> FloatArray:
        """Correlations of `number` images of each way with cuts of the other; NaN without support."""
        first, second = (
            replace(stack, world_from_sensor=steady.at(times[way] - delay_s))
            for stack, way in zip(stacks, ways, strict=True)
        )
        patches = (
            spread_patches(first, _middle(share[ways[0]], number), PIXEL_MM),
            spread_patches(second, _middle(share[ways[1]], number), PIXEL_MM),
        )
        comparison = Comparison((first, second), patches, gap_mm, LEAST_OVERLAP)
        return comparison.at(sensor_from_image).alike

    delays, rows = delays_around(around_s, search_s, STEP_S), []
    for number, delay in enumerate(delays):
        rows.append(correlations(COARSE, float(delay)))
        if progress is not None:
            progress(number + 1, len(delays))
    curves = np.array(rows)
    count = np.isfinite(curves).sum(axis=1)
    if not 2 * count.max() >= max(curves.shape[1], 1):
        raise InsufficientDataError("expected images of the two ways that meet, got none at any delay")
    # Where fewer than half of the images meet the other way, nothing is alike.
    alike = np.where(2 * count >= curves.shape[1], np.nansum(curves, axis=1) / np.maximum(count, 1), 0.0)
    misfit = 1.0 - alike
    best = peak_of(delays, misfit, f"the motion repeats itself, or {doubts}")
    width = _half_width(delays, misfit, best)
    near = np.abs(delays - delays[best]) < width + 0.5 * STEP_S
    votes = near[np.nanargmax(curves[:, np.isfinite(curves[best])], axis=0)]
    if votes.mean() < LEAST_AGREEING:
        raise InsufficientDataError(
            "expected images that show where they were taken, got only "
            f"{votes.sum()} of {len(votes)} that fit best near {delays[best]:+.3f} s, the best: {doubts}"
        )
    low, high = max(delays[best] - width, delays[0]), min(delays[best] + width, delays[-1])
    places = np.linspace(low, high, _PLACES)
    fine = np.array([correlations(FINE, float(place)) for place in places])
    seconds, scatter = _vertex(places, fine)
    # A peak must be located to well within its own width.
    if not (SIGMAS * scatter < width and low <= seconds <= high):
        raise InsufficientDataError(
            f"expected correlations with a top, got none near the best delay, {delays[best]:+.3f} s: {doubts}"
        )
    unseen = _from_tracker(steady, times - seconds, sensor_from_image, centre_mm, tracker_mm)
    return ClockOffset(seconds, float(np.hypot(scatter, unseen)), float(np.nanmean(fine, axis=1).max()))


def _there_and_back(path: FloatArray) -> tuple[int, FloatArray]:
    """Number of the frame where the motion turns, and the share of the common travel at each frame."""
    if len(path) < _FEWEST_FRAMES:
        raise InsufficientDataError(
            f"expected readings around at least {_FEWEST_FRAMES} frames, got them for {len(path)}"
        )
    along = uniform_filter1d(path @ _direction(path), 5, mode="nearest")
    along *= -1.0 if abs(along.min() - along[0]) > abs(along.max() - along[0]) else 1.0
    turn = int(np.argmax(along))
    low, high = max(along[: turn + 1].min(), along[turn:].min()), float(along[turn])
    if high - low < _LEAST_TRAVEL_MM or not 0 < turn < along.size - 1:
        raise InsufficientDataError(
            f"expected a motion forward and back over {_LEAST_TRAVEL_MM:g} mm or more, got one that comes "
            f"back by {max(high - low, 0.0):.1f} mm"
        )
    return turn, (along - low) / (high - low)


def _direction(path_mm: FloatArray) -> FloatArray:
    """Unit vector along which a path is longest."""
    return np.asarray(np.linalg.svd(path_mm - path_mm.mean(axis=0), full_matrices=False)[2][0])


def _middle(share: FloatArray, number: int) -> IntArray:
    """Frames spread over the middle of a way; at its ends the probe is too slow to show a delay."""
    inner = np.flatnonzero((share > 0.1) & (share < 0.9))
    return inner[spread_frames(inner.size, number)]


def _from_tracker(
    steady: SmoothReadings,
    times_s: FloatArray,
    sensor_from_image: RigidTransform,
    centre_mm: FloatArray,
    tracker_mm: float,
) -> float:
    """Standard error due to the tracker, which comparing images cannot show.

    Its jitter, and what it displaces one way against the other by, put both ways' mean positions off; the
    delay that makes up for it is their difference over twice the speed.
    """
    read_s = steady.time_s
    during = (read_s >= times_s[0]) & (read_s <= times_s[-1])
    raw, smooth = (
        (poses * sensor_from_image).apply(centre_mm)
        for poses in (steady.poses[during], steady.at(read_s[during]))
    )
    along = _direction(smooth)
    path = float(np.abs(np.diff(smooth @ along)).sum())
    sigma = float(np.hypot(np.std((raw - smooth) @ along) / np.sqrt(during.sum()), tracker_mm / 2.0))
    return sigma * float(times_s[-1] - times_s[0]) / path if path > 0.0 else np.inf


def _half_width(delays_s: FloatArray, misfit: FloatArray, best: int) -> float:
    """Distance from the best delay at which half of its gain over the median is lost."""
    above = np.abs(delays_s - delays_s[best])[misfit > 0.5 * (misfit[best] + float(np.median(misfit)))]
    return float(np.clip(above.min(initial=_WIDEST_S), 2.0 * STEP_S, _WIDEST_S))


def _vertex(near_s: FloatArray, curves: FloatArray) -> tuple[float, float]:
    """Vertex of a parabola through the mean correlations near the peak, and its jackknife standard error.

    A parabola, since the maximum itself ripples with the frames that happen to be there. Runs of images are
    left out together.
    """
    curves, middle = curves[:, np.isfinite(curves).all(axis=0)], float(near_s.mean())
    runs = curves.shape[1] // _BLOCK
    if runs < 2:
        return middle, np.inf
    means = curves[:, : runs * _BLOCK].reshape(len(near_s), runs, _BLOCK).mean(axis=2)
    second, first = np.polyfit(near_s - middle, means, 2)[:2]
    if not second.mean() < 0:
        return middle, np.inf
    without = -(first.sum() - first) / (2.0 * (second.sum() - second))
    scatter = np.sqrt((runs - 1.0) * np.var(without))
    return middle - float(first.mean() / (2.0 * second.mean())), float(scatter)
