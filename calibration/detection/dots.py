"""Automatic detection of bright dots in images: wires seen end on.

A dot is a maximum of the difference of two Gaussians that is not part of a line. Side lobes make it wide and
ringing gives it a tail, both weaker than the dot itself, so that its place is the centroid of the pixels
above half of its peak.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from calibration.detection.region import checked_pixel, in_every_frame, region_mask
from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.core.geometry import require_finite
from speckle3d.core.leastsquares import robust_sigma
from speckle3d.core.sweep import Frames

_FAINTEST = 0.03
"""Least contrast of a dot as a share of the strongest dot's: in an image of 60 dB that the strongest
saturates, 15 dB below it is a share of 0.75; wires off the image's plane were seen at 0.1."""
_PLACING = 0.35
"""Smoothing before a dot is placed, as part of the dot's own size: enough to join the grains of one dot."""
_ANGLES = 24
_LINE_REACH = 2.5
"""Distance from a peak, in `_SURROUND_MM`, at which it is tested for a line; the 24 directions are then less
than half a millimetre apart."""
_REACH = 2.0
"""Half the window in which a dot is placed, in `_SURROUND_MM`."""


_DOT_MM, _SURROUND_MM = 0.35, 1.2
"""Standard deviations of the Gaussian that a dot resembles, and of the one that it must stand out from."""
_APART_MM = 0.8
"""Of dots nearer to each other than this, the strongest counts."""
_NOISE_SDS = 5.0
"""Least contrast of a dot, in robust standard deviations of the whole image's."""
_LEVEL = 0.5
"""Part of its peak above which a dot's pixels count."""
_MOST_DOTS = 20


@dataclass(frozen=True)
class Dots:
    """Dots that may be wires, the strongest of each frame first.

    Attributes
    ----------
    frame : ndarray of int, shape (n,)
        Ascending.
    pixels : ndarray, shape (n, 2)
        Column and row, fractional.
    score : ndarray, shape (n,)
        Contrast with the surroundings, less that of a line the dot may be part of, grey levels.
    dropped : dict of int to str
        Why other frames have none.
    """

    frame: IntArray
    pixels: FloatArray
    score: FloatArray
    dropped: dict[int, str] = field(default_factory=dict)

    def without(self, frames: Collection[int]) -> Dots:
        """Leave out frames."""
        kept = ~np.isin(self.frame, list(frames))
        dropped = {frame: why for frame, why in self.dropped.items() if frame not in frames}
        return Dots(self.frame[kept], self.pixels[kept], self.score[kept], dropped)


def dots_in_image(
    image: npt.NDArray[Any],
    pixel_mm: npt.ArrayLike,
    region_px: npt.ArrayLike | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Find the bright dots of one image.

    Parameters
    ----------
    image : ndarray, shape (column, row)
        Grey levels of any real type, rows down from the probe.
    pixel_mm : array_like, shape (2,)
        Distance between columns and between rows, mm; ten per cent do not matter.
    region_px : array_like, shape (k, 2), optional
        Corners (column, row) of a polygon outside which nothing counts.

    Returns
    -------
    pixels : ndarray, shape (n, 2)
    score : ndarray, shape (n,)
        Contrast with the surroundings, grey levels, descending.

    Raises
    ------
    InvalidInputError
        If an argument is not what it must be.
    """
    size = checked_pixel(pixel_mm)
    if image.ndim != 2 or not np.isrealobj(image):
        raise InvalidInputError(f"image: expected real values (column, row), got {image.dtype} {image.shape}")
    inside = None if region_px is None else region_mask(image.shape, region_px)
    return _dots(image, size, inside)


def dots_in_frames(
    frames: Frames,
    pixel_mm: npt.ArrayLike,
    region_px: npt.ArrayLike | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Dots:
    """Find the bright dots of every frame, read one at a time.

    Parameters
    ----------
    frames : Frames, shape (n, column, row)
    pixel_mm, region_px
        See `dots_in_image`.
    progress : callable, optional
        Called with the number of frames done and their total.

    Raises
    ------
    InvalidInputError
        If an argument is not what it must be.
    """
    size, count = checked_pixel(pixel_mm), frames.shape[0]
    inside = None if region_px is None else region_mask(frames.shape[1:], region_px)
    found = in_every_frame(frames, lambda image: _dots(image, size, inside), progress)
    held = [len(score) for _, score in found]
    return Dots(
        frame=np.repeat(np.arange(count), held),
        pixels=np.concatenate([np.zeros((0, 2)), *(pixels for pixels, _ in found)]),
        score=np.concatenate([np.zeros(0), *(score for _, score in found)]),
        dropped={i: "no dot" for i, n in enumerate(held) if n == 0},
    )


def _dots(
    image: npt.NDArray[Any], pixel_mm: FloatArray, inside: BoolArray | None
) -> tuple[FloatArray, FloatArray]:
    grey = np.asarray(image, dtype=np.float32)
    require_finite(grey, "image")
    contrast = ndimage.gaussian_filter(grey, _DOT_MM / pixel_mm)
    contrast -= ndimage.gaussian_filter(grey, _SURROUND_MM / pixel_mm, truncate=3.0)
    limit = _limit(contrast if inside is None else contrast[inside])
    peaks = _maxima(contrast, limit, pixel_mm, inside)
    score = contrast[tuple(peaks.T)] - _along_lines(contrast, peaks, pixel_mm)
    best = np.argsort(-score, kind="stable")
    best = best[score[best] > limit][:_MOST_DOTS]
    fine = ndimage.gaussian_filter(grey, _PLACING * _DOT_MM / pixel_mm)
    places = [_placed(fine, peak, pixel_mm) for peak in peaks[best]]
    return np.reshape(places, (-1, 2)), score[best].astype(float)


def _limit(contrast: Float32Array) -> float:
    # Every seventh pixel: enough for the noise, in a seventh of the time.
    noise = robust_sigma(contrast.ravel()[::7])
    rounding = float(np.finfo(np.float32).eps * np.abs(contrast).max())
    return float(np.max([_NOISE_SDS * noise, _FAINTEST * float(contrast.max()), rounding]))


def _maxima(contrast: Float32Array, limit: float, pixel_mm: FloatArray, inside: BoolArray | None) -> IntArray:
    """Columns and rows of maxima that are `_APART_MM` apart, shape (n, 2), strongest first."""
    near = np.ones(2 * np.maximum(np.rint(_APART_MM / pixel_mm), 1).astype(int) + 1, dtype=bool)
    features = extra_module("skimage.feature", "calibrate", "finding dots of wires")
    peaks = features.peak_local_max(contrast, footprint=near, threshold_abs=limit, exclude_border=False)
    return np.asarray(peaks if inside is None else peaks[inside[tuple(peaks.T)]])


def _along_lines(contrast: Float32Array, peaks: IntArray, pixel_mm: FloatArray) -> Float32Array:
    """Contrast of lines that peaks may be part of, shape (n,): the lesser of that on two opposite sides.

    Specular echoes, as of the floor or the phantom's frame, would otherwise be taken for rows of dots.
    """
    angle = np.linspace(0.0, np.pi, _ANGLES, endpoint=False)
    away = _LINE_REACH * _SURROUND_MM * np.column_stack([np.cos(angle), np.sin(angle)]) / pixel_mm
    sides = []
    for step in (away, -away):
        places = np.rint(peaks[:, None] + step).astype(int)
        held = np.all((places >= 0) & (places < contrast.shape), axis=2)
        column, row = np.moveaxis(np.where(held[..., None], places, 0), 2, 0)
        sides.append(np.where(held, contrast[column, row], np.float32(0.0)))
    return np.asarray(np.minimum(*sides).max(axis=1, initial=0.0), dtype=np.float32)


def _placed(fine: Float32Array, peak: IntArray, pixel_mm: FloatArray) -> FloatArray:
    """Centroid of the pixels of a dot above `_LEVEL`, weighted by their height above it.

    The parts of a grainy dot count together: all that reach within `_DOT_MM` of its peak. scikit-image's
    `regionprops` knows one part only, and takes twice the time.
    """
    reach = np.rint(_REACH * _SURROUND_MM / pixel_mm).astype(int)
    start = np.maximum(peak - reach, 0)
    window = fine[start[0] : peak[0] + reach[0] + 1, start[1] : peak[1] + reach[1] + 1]
    row, column = np.meshgrid(*(np.arange(n) for n in window.shape[::-1]))
    away = np.hypot((column + start[0] - peak[0]) * pixel_mm[0], (row + start[1] - peak[1]) * pixel_mm[1])
    base = float(np.median(window))
    top = float(window[away <= _DOT_MM].max(initial=base))
    height = window - (base + _LEVEL * (top - base))
    labels = ndimage.label(height > 0)[0]
    own = np.unique(labels[(away <= _DOT_MM) & (height > 0)])
    weight = np.where(np.isin(labels, own) & (labels > 0), height, 0.0)
    total = float(weight.sum())
    if total <= 0:
        return peak.astype(float)
    centroid = np.array([float((column * weight).sum()), float((row * weight).sum())]) / total
    return np.asarray(start + centroid, dtype=float)
