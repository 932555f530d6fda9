"""Region of interest: pixels of a polygon, and columns at regular intervals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from calibration.points import Detections
from speckle3d.core.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, naming
from speckle3d.core.geometry import require_finite
from speckle3d.core.grid import polygon_mask
from speckle3d.core.progress import Progress
from speckle3d.core.sweep import Frames

_GLANCES = 48
"""Frames compared to see what stands still in all of them."""
_DENSELY = 4
"""Columns looked at to see which show anything, for each that is then sampled."""
_LIVELY = 0.25
"""Change that counts, as a share of the 90th percentile of the columns' strongest changes."""


@dataclass(frozen=True)
class Columns:
    """Sampled columns and which of their rows are in a region.

    Attributes
    ----------
    column : ndarray of int, shape (n,)
        Numbers of the columns, ascending.
    inside : ndarray of bool, shape (n, r)
        Which rows of each are in the region.
    """

    column: IntArray
    inside: BoolArray

    def fill(self, samples: Float32Array) -> Float32Array:
        """Samples, shape (n, r), with the region's first and last in each column repeated beyond it."""
        rows, last = np.arange(samples.shape[1]), samples.shape[1] - 1
        ends = self.inside.argmax(axis=1), last - self.inside[:, ::-1].argmax(axis=1)
        return np.take_along_axis(samples, np.clip(rows, *(end[:, None] for end in ends)), axis=1)


def region_mask(shape: tuple[int, ...], region_px: npt.ArrayLike | None) -> BoolArray:
    """Mask of an image's pixels in a polygon, its sides included.

    Parameters
    ----------
    shape : tuple of int
        Columns and rows of the image.
    region_px : array_like, shape (k, 2), or None
        Corners (column, row) of any simple polygon; None is the whole image.

    Raises
    ------
    InvalidInputError
        If the region is not a polygon, or covers nothing.
    """
    if region_px is None:
        return np.ones(shape, dtype=bool)
    mask = polygon_mask(np.moveaxis(np.indices(shape, float), 0, -1), region_px, "region_px")
    if not mask.any():
        raise InvalidInputError(
            f"region_px: expected a polygon that covers part of the {shape[0]} x {shape[1]} pixels, got none"
        )
    return mask


def choose_columns(
    frames: Frames, count: int, region_px: npt.ArrayLike | None, smoothing_rows: float
) -> Columns:
    """Spread columns over a polygon in the images, or over what changes in them, symmetric about its middle.

    Parameters
    ----------
    frames, region_px
        See `region_mask`.
    count : int
        Columns to sample; fewer where there are not so many.
    smoothing_rows : float
        Standard deviation of the smoothing with which changes are looked for.

    Raises
    ------
    InvalidInputError
        If the region is not a polygon, or covers nothing.
    """
    mask = region_mask(frames.shape[1:], region_px)
    column = np.flatnonzero(mask.any(axis=1))
    if region_px is None and frames.shape[0] > 0:
        column = column[spread(column.size, _DENSELY * count)]
        mask[column] = _changing(frames, column, smoothing_rows)
        column = column[mask[column].any(axis=1)]
    column = column[spread(column.size, count)] if column.size else column
    return Columns(column, mask[column])


def _changing(frames: Frames, column: IntArray, smoothing_rows: float) -> BoolArray:
    """Mask of columns without those that never change, and without what stands still above all change.

    The floor's echo moves; lettering, a screen's border and the transducer's ring-down do not. Dark water
    stays in, since the floor may be shallower in frames that were not compared. If all frames are alike,
    everything stays in.
    """
    low, high = np.full((2, column.size, frames.shape[2]), np.nan, np.float32)
    for index in np.unique(np.linspace(0, frames.shape[0] - 1, _GLANCES).astype(int)):
        image = np.asarray(frames[int(index)][column], np.float32)
        low, high = np.fmin(low, image), np.fmax(high, image)
    low, high = np.nan_to_num(low), np.nan_to_num(high)
    change, level = (gaussian_filter1d(x, smoothing_rows / 2, axis=1) for x in (high - low, low - low.min()))
    limit = _LIVELY * np.percentile(change.max(axis=1), 90)
    if not limit > 0:
        return np.ones_like(low, dtype=bool)
    lively = change > limit
    standing = (level > limit) & ~np.logical_or.accumulate(lively, axis=1)
    under = ~np.logical_or.accumulate(standing[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(under & lively.any(axis=1)[:, None])


def spread(size: int, count: int) -> IntArray:
    """About `count` of the numbers below `size`, at regular intervals and symmetric about the middle."""
    left = np.rint(np.linspace(0, size - 1, count)[: (count + 1) // 2]).astype(np.int64)
    return np.unique(np.concatenate([left, size - 1 - left]))


def finite_grey(image: AnyArray) -> Float32Array:
    """Grey levels of a frame, all finite."""
    grey = np.asarray(image, dtype=np.float32)
    require_finite(grey, "image")
    return grey


def detect_in_frames(
    frames: Frames,
    find: Callable[[AnyArray], tuple[FloatArray, FloatArray]],
    progress: Progress | None = None,
) -> Detections:
    """Apply a detector to every frame but repeats, read one at a time; an error names the frame.

    Parameters
    ----------
    frames : Frames, shape (n, column, row)
    find : callable
        Returns places, shape (k, 2) of dots or (k, 2, 2) of lines, and their scores, the best first; or
        raises `InsufficientDataError`, saying why a frame shows nothing.
    progress : callable, optional
        Called with the number of frames done and their total.
    """
    count, numbers, reasons = frames.shape[0], list[int](), dict[int, str]()
    detections, previous = list[tuple[FloatArray, FloatArray]](), np.zeros(0)
    for index in range(count):
        # A copy: frames may share their memory.
        image = np.array(frames[index])
        with naming(f"frame {index}"):
            try:
                if np.array_equal(image, previous):
                    raise InsufficientDataError("the image repeats the one before")
                detections.append(find(image))
                numbers += [index] * len(detections[-1][1])
            except InsufficientDataError as error:
                reasons[index] = str(error)
        previous = image
        if progress:
            progress(index + 1, count)
    pixels, scores = map(np.concatenate, zip(*detections, strict=True)) if detections else np.zeros((2, 0, 2))
    return Detections(np.array(numbers, dtype=np.int64), pixels, None, reasons, scores)
