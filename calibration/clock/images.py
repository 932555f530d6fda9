"""Clock offset between images and a tracker, from tissue that the probe passes twice, forward and back.

A wrong offset shifts all images of the way forward to one side and all of the way back to the other, so that
images of one way do not correlate with reslices of the other. Neither a phantom nor an accurate spatial
calibration is needed, since the motion is along one line.

Even noise correlates best at some delay, so each image votes with its own best delay, and most must agree.

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
from scipy.spatial.transform import RigidTransform

from calibration.clock.offset import (
    SEARCH_S,
    ClockOffset,
    covered,
    delays_around,
    minimum_between,
    require_peak,
)
from calibration.clock.smoothing import smooth
from calibration.images.stacks import TrackedImages, block_means
from speckle3d.core.arrays import Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.streams import TimedPoses
from speckle3d.core.sweep import ImageGrid
from speckle3d.imaging.cuts.planes import image_plane
from speckle3d.imaging.cuts.reslice import resample_image, reslice_frames
from speckle3d.imaging.images import ChosenImages, Images

STEP_S = 0.01

LEAST_AGREEING = 0.5
"""Share of the compared images whose own best delay must be near the common one; the strength of speckle and
noise does not enter. It is 0.7 to 1 for simulated tissue and at least 0.56 under noise twice as strong as the
picture; up to 0.44 for noise, shuffled images, ones that never change and delays outside the range. It was
more for images reversed in time and ones 1.2 s late, in which no peak could be located."""

LEAST_CORRELATION = 0.1
"""Least mean correlation of images with their reslices at the best delay. The best of a hundred delays
reaches 0.06 for noise as smooth as speckle, and 0.23 for tissue under noise of twice its strength."""

SIGMAS = 3.0
_WIDEST_S = 0.1
_BLOCK = 5
_RESAMPLES = 200

PIXEL_MM = 0.3
"""Pixel of the compared images: finer than the beam, since speckle, seen again on the way back, helps."""

COARSE, FINE = 8, 60
"""Images of each way compared to find the peak, and to locate it; the paper takes four. A tracker's jitter of
0.15 mm is 15 ms at 10 mm/s, and only many images average it out."""

_PLACES = 9
_LEAST_TRAVEL_MM = 2.0
"""About an elevational beam width: over less travel all images look alike."""

_FEWEST_FRAMES = 20
_SMALLEST_SHARE = 0.3


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
    steady = smooth(readings)
    ways = _there_and_back(there, steady.at(frame_time_s[there] - around_s) * sensor_from_image, grid)
    source = _Correlations(_Pooled(tracked.images, grid), frame_time_s, steady, sensor_from_image, ways)
    coarse, fine = (source.of(number) for number in (min(COARSE, queries), queries))
    tried, curves = _curves_at(coarse, delays_around(around_s, search_s, STEP_S), progress)
    misfit = np.array([1.0 - _mean_of(each) for each in curves])
    best = _clear_peak(tried, curves, misfit, search_s)
    width = _half_width(tried, misfit, best)
    near, misfit_there = minimum_between(lambda delay: 1.0 - _mean_of(fine(delay)), tried, best, 2e-4)
    low, high = max(near - width, tried[0]), min(near + width, tried[-1])
    seconds, scatter = _placed(fine, np.linspace(low, high, _PLACES))
    # A peak must be located to well within its own width.
    if not (misfit_there < 1.0 and SIGMAS * scatter < width and low <= seconds <= high):
        raise InsufficientDataError(
            f"expected correlations with a top, got none near the best delay, {near:+.3f} s: "
            f"{_doubts(search_s)}"
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


@dataclass(frozen=True)
class _Way:
    """Frames of one way, and the share of the common travel at each."""

    frames: IntArray
    share: FloatArray

    def queries(self, number: int) -> IntArray:
        """Frames spread over the middle of the way; at its ends the probe is too slow to show a delay."""
        inner = self.frames[(self.share > 0.1) & (self.share < 0.9)]
        chosen = np.linspace(0, inner.size - 1, min(number, inner.size)).round().astype(int)
        return np.asarray(inner[np.unique(chosen)])


@dataclass(frozen=True)
class _Correlations:
    """Correlation of images with their reslices through the other way's frames, at any delay."""

    images: _Pooled
    frame_time_s: FloatArray
    readings: TimedPoses
    sensor_from_image: RigidTransform
    ways: tuple[_Way, _Way]

    def of(self, number: int) -> Callable[[float], FloatArray]:
        """Correlations of so many queries of each way as a function of the delay, NaN without support."""
        queries = [way.queries(number) for way in self.ways]
        # An image in its own plane is the same whatever the delay.
        own = [
            [resample_image(self.images, int(k), self.images.grid, PIXEL_MM) for k in chosen]
            for chosen in queries
        ]

        def at(delay_s: float) -> FloatArray:
            found = []
            for chosen, shown, other in zip(queries, own, self.ways[::-1], strict=True):
                poses = self._poses(other.frames, delay_s)
                reach, source = _reach_mm(poses), ChosenImages(self.images, other.frames)
                for image, pose in zip(shown, self._poses(chosen, delay_s), strict=True):
                    plane = image_plane(pose, self.images.grid, PIXEL_MM)
                    found.append(
                        _correlation(image, reslice_frames(source, self.images.grid, poses, plane, reach))
                    )
            return np.array(found)

        return at

    def _poses(self, frames: IntArray, delay_s: float) -> RigidTransform:
        return self.readings.at(self.frame_time_s[frames] - delay_s) * self.sensor_from_image


def _there_and_back(frames: IntArray, poses: RigidTransform, grid: ImageGrid) -> tuple[_Way, _Way]:
    if len(poses) < _FEWEST_FRAMES:
        raise InsufficientDataError(
            f"expected readings around at least {_FEWEST_FRAMES} frames, got them for {len(poses)}"
        )
    path = poses.apply(grid.centre_mm)
    along = uniform_filter1d(path @ _direction(path), 5, mode="nearest")
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
    return _Way(frames[: turn + 1], share[: turn + 1]), _Way(frames[turn:], share[turn:])


def _direction(path_mm: FloatArray) -> FloatArray:
    """Unit vector along which a path is longest."""
    return np.asarray(np.linalg.svd(path_mm - path_mm.mean(axis=0), full_matrices=False)[2][0])


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
    times = readings.time_s[used]
    raw, held = (
        (poses * sensor_from_image).apply(grid.centre_mm)
        for poses in (readings.world_from_sensor[used], steady.at(times))
    )
    along = _direction(held)
    path = float(np.abs(np.diff(held @ along)).sum())
    if path == 0.0:
        return float("inf")
    sigma = float(np.std((raw - held) @ along))
    speed = path / float(times_s[-1] - times_s[0])
    return float(sigma * 2.0 / np.sqrt(used.sum()) / (2.0 * speed))


def _mean_of(correlations: FloatArray) -> float:
    """Mean over the queries; zero where fewer than half have support."""
    held = np.isfinite(correlations)
    return float(correlations[held].mean()) if 2 * held.sum() >= max(correlations.size, 1) else 0.0


def _curves_at(
    correlations: Callable[[float], FloatArray],
    tried_s: FloatArray,
    progress: Callable[[int, int], None] | None,
) -> tuple[FloatArray, FloatArray]:
    """Delays at which enough queries have support, and their correlations there, shape (k, queries)."""
    rows = []
    for number, delay in enumerate(tried_s):
        rows.append(correlations(float(delay)))
        if progress is not None:
            progress(number + 1, len(tried_s))
    curves = np.array(rows)
    held = 2 * np.isfinite(curves).sum(axis=1) >= max(curves.shape[1], 1)
    if not held.any():
        raise InsufficientDataError("expected images of the two ways that meet, got none at any delay")
    return tried_s[held], curves[held]


def _clear_peak(tried_s: FloatArray, curves: FloatArray, misfit: FloatArray, search_s: float) -> int:
    """Index of the best delay, if it is inside the range, images correlate there, and most agree."""
    best = int(np.argmin(misfit))
    beside = tried_s[max(best - 1, 0) : best + 2]
    # Delays without enough supported images were dropped, so the range may also end within the one tried.
    if beside.size < 3 or np.ptp(beside) > 3.0 * STEP_S:
        raise InsufficientDataError(
            f"expected a delay inside the {search_s:g} s searched either way, got {tried_s[best]:+.3f} s, at "
            f"the range's end: the delay may lie outside the {search_s:g} s searched: --search-s"
        )
    if 1.0 - misfit[best] < LEAST_CORRELATION:
        raise InsufficientDataError(
            f"expected images of the two ways that correlate by {LEAST_CORRELATION:g} or more at some delay, "
            f"got {1.0 - misfit[best]:.2f} at best: {_doubts(search_s)}"
        )
    require_peak(tried_s, misfit, best, f"the motion repeats itself, or {_doubts(search_s)}")
    near = np.abs(tried_s - tried_s[best]) < _half_width(tried_s, misfit, best) + 0.5 * STEP_S
    there = curves[:, np.isfinite(curves[best])]
    agree, count, chance = int(near[np.nanargmax(there, axis=0)].sum()), there.shape[1], float(near.mean())
    luck = min(1.0, chance + SIGMAS * np.sqrt(chance * (1.0 - chance) / count))
    if agree < max(LEAST_AGREEING, luck) * count:
        raise InsufficientDataError(
            "expected images that show where they were taken, got only "
            f"{agree} of {count} that fit best near {tried_s[best]:+.3f} s, the best delay of all: "
            f"{_doubts(search_s)}"
        )
    return best


def _doubts(search_s: float) -> str:
    """Likely causes where no delay is better than chance, for messages."""
    return (
        "images and readings do not belong together, or the delay lies outside the "
        f"{search_s:g} s searched: --search-s"
    )


def _half_width(tried_s: FloatArray, misfit: FloatArray, best: int) -> float:
    """Distance from the best delay at which half of its gain over the median is lost."""
    half = 0.5 * (misfit[best] + float(np.median(misfit)))
    above = np.flatnonzero(misfit > half)
    nearest = float(np.abs(tried_s[above] - tried_s[best]).min()) if above.size else _WIDEST_S
    return min(max(nearest, 2.0 * STEP_S), _WIDEST_S)


def _placed(correlations: Callable[[float], FloatArray], near_s: FloatArray) -> tuple[float, float]:
    """Vertex of a parabola through the mean correlations near the peak, and its bootstrap standard error.

    A parabola, since the maximum itself ripples with the frames that happen to be there. Runs of queries are
    resampled, since neighbours share frames of the other way.
    """
    curves = np.array([correlations(float(each)) for each in near_s])
    curves = curves[:, np.isfinite(curves).all(axis=0)]
    middle = float(near_s.mean())
    runs = curves.shape[1] // _BLOCK
    if runs < 2:
        return middle, float("inf")
    means = curves[:, : runs * _BLOCK].reshape(len(near_s), runs, _BLOCK).mean(axis=2)
    second, first = np.polyfit(near_s - middle, means, 2)[:2]
    drawn = np.random.default_rng(0).integers(0, runs, (_RESAMPLES, runs))
    if not second.mean() < 0:
        return middle, float("inf")
    scatter = np.std(-first[drawn].mean(axis=1) / (2.0 * second[drawn].mean(axis=1)))
    return middle - float(first.mean() / (2.0 * second.mean())), float(scatter)
