"""Clock offset between images and a tracker, from tissue that the probe passes twice, forward and back.

A wrong offset shifts all images of the way forward to one side and all of the way back to the other, so that
images of one way do not correlate with reslices of the other. Neither a phantom nor an accurate spatial
calibration is needed, since the motion is along one line.

References
----------
.. [1] W. Wein and A. Khamene, "Image-based method for in-vivo freehand ultrasound calibration", SPIE Medical
   Imaging 6920, 2008, section 3.3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import savgol_filter
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.clock.offset import SEARCH_S, ClockOffset, covered, delays_around, minimum_between
from calibration.clock.peak import SIGMAS, STEP_S, clear_peak, curves_at, doubts, half_width, mean_of, placed
from calibration.images.stacks import TrackedImages, block_means
from speckle3d.core.arrays import Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.streams import TimedPoses
from speckle3d.core.sweep import ImageGrid
from speckle3d.imaging.images import ChosenImages, Images
from speckle3d.imaging.reslice import image_plane, resample_image, reslice_frames

PIXEL_MM = 0.3
"""Pixel of the compared images: finer than the beam, since speckle, seen again on the way back, helps."""

COARSE, FINE = 8, 60
"""Images of each way compared to find the peak, and to locate it; the paper takes four. A tracker's jitter of
0.15 mm is 15 ms at 10 mm/s, and only many images average it out."""

_SMOOTHED_S = 0.2
_PLACES = 9
_LEAST_TRAVEL_MM = 2.0
"""About an elevational beam width: over less travel all images look alike."""

_FEWEST_FRAMES = 20
_SMALLEST_SHARE = 0.3


@dataclass(frozen=True)
class _Way:
    """Frames of one way, and those of them that are compared with the other."""

    frames: IntArray
    queries: IntArray


def delay_from_images(
    tracked: TrackedImages,
    sensor_from_image: RigidTransform,
    search_s: float = SEARCH_S,
    queries: int = FINE,
    progress: Callable[[int, int], None] | None = None,
) -> ClockOffset:
    """Find the delay at which images of either way correlate best with reslices of the other.

    Parameters
    ----------
    tracked : TrackedImages
        A motion forward and back; its readings are interpolated by slerp.
    sensor_from_image : RigidTransform
        A rough one is enough.
    search_s : float
        Delays within it of the recording's own are tried.
    queries : int
        Images of each way that place the peak.

    Raises
    ------
    InsufficientDataError
        If the probe does not go forward and back, or stays in the plane of its images, the images do not show
        where they were taken, the best delay is at the end of the range, or another is as good, as with a
        periodic motion.
    """
    if queries < 2:
        raise InvalidInputError(f"queries: expected at least 2, got {queries}")
    grid, frame_time_s, readings = tracked.grid, tracked.frame_time_s, tracked.readings
    around_s = tracked.time_offset_s
    there = np.flatnonzero(covered(readings, frame_time_s, around_s, search_s))
    steady = smoothed(readings, _SMOOTHED_S)
    part = _there_and_back(steady.at(frame_time_s[there] - around_s) * sensor_from_image, grid)
    pooled = _Pooled(tracked.images, grid)

    def correlations(number: int) -> _Correlations:
        ways = tuple(_way(there, each, number) for each in part)
        return _Correlations(pooled, frame_time_s, steady, sensor_from_image, ways)

    tried = delays_around(around_s, search_s, STEP_S)
    tried, curves = curves_at(correlations(min(COARSE, queries)), tried, progress)
    misfit = np.array([1.0 - mean_of(each) for each in curves])
    best = clear_peak(tried, curves, misfit, search_s)
    fine, width = correlations(queries), half_width(tried, misfit, best)
    near, misfit_there = minimum_between(lambda delay: 1.0 - mean_of(fine(delay)), tried, best, 2e-4)
    low, high = max(near - width, tried[0]), min(near + width, tried[-1])
    seconds, scatter = placed(fine, np.linspace(low, high, _PLACES))
    # A peak must be located to well within its own width.
    if not (misfit_there < 1.0 and SIGMAS * scatter < width and low <= seconds <= high):
        raise InsufficientDataError(
            f"expected correlations with a top, got none near the best delay, {near:+.3f} s: "
            f"{doubts(search_s)}"
        )
    jitter = _from_jitter(readings, steady, frame_time_s[there] - seconds, sensor_from_image, grid)
    error = float(np.hypot(scatter, jitter))
    if not error < search_s:
        raise InsufficientDataError(
            f"expected readings that tell the delay, got {seconds:+.3f} s +- {error:.3g} s from their jitter "
            f"alone, no better than the {search_s:g} s searched: move the probe faster"
        )
    return ClockOffset(seconds, error, 1.0 - misfit_there)


class _Pooled:
    """Images averaged down to pixels of about `PIXEL_MM`, kept once they have been read."""

    def __init__(self, images: Images, grid: ImageGrid) -> None:
        self._images = images
        across = max(1, round(PIXEL_MM / grid.vector_pitch_mm))
        down = max(1, round(PIXEL_MM / grid.sample_spacing_mm))
        self._by = across, down
        self.grid = ImageGrid(
            grid.vectors // across,
            grid.samples // down,
            grid.vector_pitch_mm * across,
            grid.sample_spacing_mm * down,
            grid.first_sample_depth_mm + (down - 1) / 2 * grid.sample_spacing_mm,
        )
        self._kept: dict[int, Float32Array] = {}

    def __getitem__(self, index: int) -> Float32Array:
        if index not in self._kept:
            image = self._images(index) if callable(self._images) else self._images[index]
            self._kept[index] = block_means(np.asarray(image, dtype=np.float32), self._by)
        return self._kept[index]


class _Correlations:
    """Correlation of each query with its reslice through the other way's frames, at any delay."""

    def __init__(
        self,
        images: _Pooled,
        frame_time_s: FloatArray,
        readings: TimedPoses,
        sensor_from_image: RigidTransform,
        ways: tuple[_Way, ...],
    ) -> None:
        self._images, self._times, self._readings = images, frame_time_s, readings
        self._mounting, self._ways = sensor_from_image, ways
        # An image in its own plane is the same whatever the delay.
        self._own = {
            int(k): resample_image(images, int(k), images.grid, PIXEL_MM) for way in ways for k in way.queries
        }

    def __call__(self, delay_s: float) -> FloatArray:
        """Correlations, NaN where a query's reslice has too little support; shape (queries,)."""
        found = []
        for mine, other in (self._ways, self._ways[::-1]):
            poses = self._poses(other.frames, delay_s)
            reach, source = _reach_mm(poses), ChosenImages(self._images, other.frames)
            for query, pose in zip(mine.queries, self._poses(mine.queries, delay_s), strict=True):
                plane = image_plane(pose, self._images.grid, PIXEL_MM)
                resliced = reslice_frames(source, self._images.grid, poses, plane, reach)
                found.append(_correlation(self._own[int(query)], resliced))
        return np.array(found)

    def _poses(self, frames: IntArray, delay_s: float) -> RigidTransform:
        return self._readings.at(self._times[frames] - delay_s) * self._mounting


def smoothed(readings: TimedPoses, window_s: float) -> TimedPoses:
    """Reduce the jitter of readings by local parabolas over `window_s`, which follow a hand's motion.

    Between gaps each stretch is smoothed by itself; one too short for a window stays as it is.
    """
    step = float(np.median(np.diff(readings.time_s))) if len(readings) > 1 else window_s
    width = 2 * round(window_s / step / 2) + 1
    if width < 5:
        return readings
    rotation, translation = readings.world_from_sensor.rotation, readings.world_from_sensor.translation
    vectors = np.column_stack([translation, (rotation[0].inv() * rotation).as_rotvec()])
    edges = np.flatnonzero(np.diff(readings.time_s) > readings.max_gap_s) + 1
    for part in np.split(np.arange(len(readings)), edges):
        if part.size >= width:
            vectors[part] = savgol_filter(vectors[part], width, 2, axis=0)
    turned = rotation[0] * Rotation.from_rotvec(vectors[:, 3:])
    poses = RigidTransform.from_components(vectors[:, :3], turned)
    return TimedPoses(readings.time_s, poses, readings.max_gap_s)


@dataclass(frozen=True)
class _Part:
    """Frames of one way by index, and the share of the common travel at each."""

    index: IntArray
    share: FloatArray


def _there_and_back(poses: RigidTransform, grid: ImageGrid) -> tuple[_Part, _Part]:
    if len(poses) < _FEWEST_FRAMES:
        raise InsufficientDataError(
            f"expected readings around at least {_FEWEST_FRAMES} frames, got them for {len(poses)}"
        )
    path = poses.apply(grid.centre_mm)
    middle = path - path.mean(axis=0)
    along = middle @ np.linalg.svd(middle, full_matrices=False)[2][0]
    along = uniform_filter1d(along, 5, mode="nearest")
    along *= -1.0 if abs(along.min() - along[0]) > abs(along.max() - along[0]) else 1.0
    turn = int(np.argmax(along))
    low, high = max(along[: turn + 1].min(), along[turn:].min()), float(along[turn])
    if high - low < _LEAST_TRAVEL_MM or not 0 < turn < along.size - 1:
        raise InsufficientDataError(
            f"expected a motion forward and back over {_LEAST_TRAVEL_MM:g} mm or more, got one that comes "
            f"back by {max(high - low, 0.0):.1f} mm"
        )
    _require_across(poses, grid)
    share = (along - low) / (high - low)
    ways = np.arange(turn + 1), np.arange(turn, along.size)
    return _Part(ways[0], share[ways[0]]), _Part(ways[1], share[ways[1]])


def _require_across(poses: RigidTransform, grid: ImageGrid) -> None:
    """Refuse a motion within the image plane, in which no image cuts another."""
    normal = poses.rotation.apply([0.0, 0.0, 1.0]).mean(axis=0)
    places = np.array([poses.apply(corner) for corner in grid.corners_mm])
    across = float(np.ptp(places @ (normal / np.linalg.norm(normal)), axis=1).max())
    if across < _LEAST_TRAVEL_MM:
        raise InsufficientDataError(
            f"expected a motion across the image's plane of {_LEAST_TRAVEL_MM:g} mm or more, an elevational "
            f"beam width, got {across:.1f} mm: slide the probe towards one of its flat sides and back"
        )


def _way(there: IntArray, part: _Part, number: int) -> _Way:
    """Choose queries evenly over the middle of the way; at its ends the probe is too slow to show a delay."""
    inner = part.index[(part.share > 0.1) & (part.share < 0.9)]
    chosen = np.unique(np.linspace(0, inner.size - 1, min(number, inner.size)).round().astype(int))
    return _Way(there[part.index], there[inner[chosen]])


def _reach_mm(poses: RigidTransform) -> float:
    """Largest distance of an image from a pixel: twice the 95th percentile of the steps between frames."""
    steps = np.linalg.norm(np.diff(poses.translation, axis=0), axis=1)
    return max(1.0, 2.0 * float(np.percentile(steps, 95)))


def _correlation(image: Float32Array, resliced: Float32Array) -> float:
    """Normalised cross-correlation where both have values; NaN if that is too little of the image."""
    both = np.isfinite(image) & np.isfinite(resliced)
    if both.sum() < _SMALLEST_SHARE * image.size:
        return float("nan")
    one, other = (each[both].astype(float) for each in (image, resliced))
    if not (np.ptp(one) > 0 and np.ptp(other) > 0):
        return float("nan")
    return float(np.corrcoef(one, other)[0, 1])


def _from_jitter(
    readings: TimedPoses,
    steady: TimedPoses,
    times_s: FloatArray,
    sensor_from_image: RigidTransform,
    grid: ImageGrid,
) -> float:
    """Standard error due to the tracker's jitter, which comparing images cannot show.

    Jitter puts both ways' mean positions off; the delay that makes up for it is their difference over twice
    the speed.
    """
    used = (readings.time_s >= times_s[0]) & (readings.time_s <= times_s[-1])
    raw, held = (
        (each.world_from_sensor[used] * sensor_from_image).apply(grid.centre_mm)
        for each in (readings, steady)
    )
    travel = held - held.mean(axis=0)
    along = np.linalg.svd(travel, full_matrices=False)[2][0]
    path = float(np.abs(np.diff(travel @ along)).sum())
    if path == 0.0:
        return float("inf")
    sigma = float(np.std((raw - held) @ along))
    speed = path / float(times_s[-1] - times_s[0])
    return float(sigma * 2.0 / np.sqrt(used.sum()) / (2.0 * speed))
