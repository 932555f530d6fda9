"""Tracked images reduced for comparison: blurred and resampled.

Interpolation smooths, and smoothing alone changes a similarity. So both sides of every comparison are first
brought to one resolution, coarser than speckle and than the distance between images: blurred within the
images, and averaged with their neighbours across them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.points import Recording
from speckle3d.core.arrays import Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.core.progress import Progress
from speckle3d.core.threads import in_parallel

BASE_PIXEL_MM = 0.35
"""Pixel size to which images are reduced: half the finest blur that comparisons use."""

FEWEST_FRAMES = 10

WHOLE = 0.93
"""Share of a Gaussian that lies on the image if its centre is 1.5 standard deviations or more inside."""

_PIXELS_PER_BLUR = 2.0
"""Pixels per standard deviation of the blur, so that linear interpolation loses under 2 % of any wave."""

_SMOOTHED_FRAMES = 3.0
"""Standard deviation, in frames, of the smoothing of positions before the distance travelled is measured."""


@dataclass(frozen=True)
class Stack:
    """Images of one resolution with the sensor's pose at each.

    Attributes
    ----------
    images : ndarray of float32, shape (n, u, v)
        NaN where they show nothing.
    pixels : ndarray, shape (4,)
        Pixel size along u and v, and where the first pixel's centre lies, mm.
    world_from_sensor : RigidTransform, length n
    """

    images: Float32Array
    pixels: FloatArray
    world_from_sensor: RigidTransform

    @cached_property
    def sensor_matrices(self) -> FloatArray:
        """World from sensor, shape (n, 4, 4)."""
        return self.world_from_sensor.as_matrix()

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: IntArray) -> Stack:
        return Stack(self.images[index], self.pixels, self.world_from_sensor[index])

    @property
    def centre_mm(self) -> FloatArray:
        """The images' centre in the image's frame, shape (3,)."""
        return np.asarray(self.corners_mm.mean(axis=0))

    @property
    def corners_mm(self) -> FloatArray:
        """The corner pixels' centres in the image's frame, shape (4, 3)."""
        last = np.array(self.images.shape[1:]) - 1.0
        share = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        return np.column_stack([self.pixels[2:] + share * last * self.pixels[:2], np.zeros(4)])

    def blur(self, sigma_mm: float, least_weight: float = WHOLE) -> Stack:
        """Blur the images by a Gaussian and reduce them to the pixels it needs.

        Parameters
        ----------
        least_weight : float
            Share of the Gaussian that must lie on the image. At a border a truncated Gaussian shows what
            lies farther in, alike in all images, which biases a calibration along the beams: by half a
            millimetre at a blur of 2 mm with a share of a half.
        """
        sigma = np.append(0.0, sigma_mm / self.pixels[:2])
        steps = np.maximum(1, np.floor(sigma[1:] / _PIXELS_PER_BLUR + 1e-6)).astype(int)
        coarse = np.empty_like(self.images[:, :: steps[0], :: steps[1]], order="C")

        def blur_part(first: int, stop: int) -> None:
            images = self.images[first:stop]
            valid = np.isfinite(images)
            grey, weight = (
                gaussian_filter(values, sigma, mode="constant", truncate=3.0)
                for values in (np.where(valid, images, np.float32(0.0)), valid.astype(np.float32))
            )
            grey /= np.maximum(weight, np.float32(1e-6))
            grey[~valid | (weight <= least_weight)] = np.nan
            coarse[first:stop] = grey[:, :: steps[0], :: steps[1]]

        in_parallel(blur_part, len(self), grain=8)
        pixels = np.concatenate([self.pixels[:2] * steps, self.pixels[2:]])
        return replace(self, images=coarse, pixels=pixels)

    def path_mm(self, sensor_from_image: RigidTransform) -> FloatArray:
        """Distance travelled along the normals up to each image, mm: mean of the corners, smoothed.

        Corners are used since the centre of a fan does not move if the start puts it on the fan's axis.
        """
        poses = self.world_from_sensor * sensor_from_image
        normal = poses.rotation.apply([0.0, 0.0, 1.0])[1:]
        places = np.stack([poses.apply(corner) for corner in self.corners_mm])
        places = gaussian_filter1d(places, _SMOOTHED_FRAMES, axis=1, mode="nearest")
        steps = np.abs(np.einsum("cij,ij->ci", np.diff(places, axis=1), normal)).mean(axis=0)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def spacing_mm(self, sensor_from_image: RigidTransform) -> float:
        """Mean distance between neighbouring images along their normals."""
        return float(self.path_mm(sensor_from_image)[-1] / max(len(self) - 1, 1))

    def resample(self, sensor_from_image: RigidTransform, spacing_mm: float, sigma_mm: float) -> Stack:
        """Average neighbouring images and their poses by a Gaussian, at equal distances along the sweep.

        Parameters
        ----------
        sensor_from_image : RigidTransform
            Roughly: for the distance between images, and for the centres that averaging keeps in place.
        """
        to_centre = sensor_from_image * RigidTransform.from_translation(self.centre_mm)
        centre = self.world_from_sensor * to_centre
        path = self.path_mm(sensor_from_image)
        count = max(2, int(path[-1] / spacing_mm) + 1)
        knots = np.linspace(path[0], path[-1], count)
        weight = np.exp(-0.5 * ((path - knots[:, None]) / sigma_mm) ** 2) + 1e-12
        # Frames count by the distance they stand for, so that a pause does not outweigh its neighbours.
        weight *= np.maximum(np.gradient(path), 1e-3 * path[-1] / len(path))
        weight /= weight.sum(axis=1, keepdims=True)
        turns = Rotation.concatenate([centre.rotation.mean(row) for row in weight])
        centres = RigidTransform.from_components(weight @ centre.translation, turns)
        flat, share = self.images.reshape(len(self), -1), weight.astype(np.float32)
        valid = np.isfinite(flat)
        support = share @ valid.astype(np.float32)
        total = share @ np.where(valid, flat, np.float32(0.0))
        # Nothing where the images that count most show nothing.
        mean = np.where(support > 0.5, total / np.maximum(support, np.float32(1e-6)), np.float32(np.nan))
        images = mean.reshape(count, *self.images.shape[1:]).astype(np.float32)
        return Stack(images, self.pixels, centres * to_centre.inv())


def read_stack(
    recording: Recording,
    pixel_mm: float = BASE_PIXEL_MM,
    progress: Progress | None = None,
) -> tuple[Stack, IntArray]:
    """Read a sweep's images, reduced to about `pixel_mm`, and their frame numbers.

    Pixels that never change are not part of the picture (a sector's surroundings, writing): they become NaN.

    Raises
    ------
    InsufficientDataError
        If readings cover too few frames, or no pixel ever changes.
    """
    frames = recording.covered()
    if len(frames) < FEWEST_FRAMES:
        raise InsufficientDataError(
            f"{recording.name}: expected at least {FEWEST_FRAMES} frames with readings, got {len(frames)}"
        )
    grid = recording.grid
    size = recording.pixel_mm
    bins = np.minimum(np.maximum(1, np.round(pixel_mm / size)).astype(int), [grid.vectors, grid.samples])
    shape = (len(frames), grid.vectors // bins[0], grid.samples // bins[1])
    if min(shape[1:]) < 8:
        raise InvalidInputError(
            f"{recording.name}: expected images of at least 8 pixels of {pixel_mm:g} mm either way, "
            f"got {shape[1]} x {shape[2]}"
        )
    transform = extra_module("skimage.transform", "calibrate", "a calibration from images")
    images = np.empty(shape, np.float32)
    for n, frame in enumerate(frames):
        # Whole blocks; a block is NaN where any of its pixels is.
        whole = np.asarray(recording.images[int(frame)], np.float32)
        whole = whole[: shape[1] * bins[0], : shape[2] * bins[1]]
        images[n] = transform.downscale_local_mean(whole, tuple(bins))
        if progress:
            progress(n + 1, len(frames))
    still = ~(np.ptp(images, axis=0) > 0)
    if still.all():
        raise InsufficientDataError(
            f"{recording.name}: expected images that change, got the same in all frames"
        )
    images[:, still & ~np.isnan(images).any(axis=0)] = np.nan
    first = size * (bins - 1) / 2.0 + [grid.first_vector_mm, grid.first_sample_depth_mm]
    return Stack(images, np.concatenate([size * bins, first]), recording.world_from_sensor(frames)), frames
