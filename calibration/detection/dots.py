"""Automatic detection of bright dots in images: wires seen end on.

A dot is a maximum of the difference of two Gaussians that is not part of a line. Side lobes make it wide and
ringing gives it a tail, both weaker than the dot itself: its place is the centre of what is bright, by mean
shift.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from calibration.detection.region import detect_in_frames, finite_grey, region_mask
from calibration.points import Detections
from speckle3d.core.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.extras import extra_module
from speckle3d.core.leastsquares import robust_sigma
from speckle3d.core.progress import Progress
from speckle3d.core.sweep import Frames

_FAINTEST = 0.03
"""Least contrast of a dot as a share of the strongest dot's: in an image of 60 dB that the strongest
saturates, 15 dB below it is a share of 0.75; wires off the image's plane were seen at 0.1."""
_ANGLES = 24
_LINE_REACH = 2.5
"""Distance from a peak, in `_SURROUND_MM`, at which it is tested for a line; the 24 directions are then less
than half a millimetre apart."""
_SHIFTS, _NEAR_MM = 5, 1.0
"""Steps of the mean shift that centres a dot, and the standard deviation of its window; a bead is then placed
to 0.02 mm."""

_DOT_MM, _SURROUND_MM = 0.35, 1.2
"""Standard deviations of the Gaussian that a dot resembles, and of the one that it must stand out from."""
_APART_MM = 0.8
"""Of dots nearer to each other than this, the strongest counts."""
_NOISE_SDS = 5.0
"""Least contrast of a dot, in robust standard deviations of the whole image's."""
_MOST_DOTS = 20


def dots_in_frames(
    frames: Frames,
    pixel_mm: FloatArray,
    region_px: npt.ArrayLike | None = None,
    progress: Progress | None = None,
) -> Detections:
    """Find the bright dots of every frame, read one at a time.

    Parameters
    ----------
    frames : Frames, shape (n, column, row)
    pixel_mm : ndarray, shape (2,)
        Distance between columns and between rows, mm; ten per cent do not matter.
    region_px : array_like, shape (k, 2), optional
        Corners (column, row) of a polygon outside which nothing counts.
    progress : callable, optional
        Called with the number of frames done and their total.

    Raises
    ------
    InvalidInputError
        If an argument is not what it must be.
    """
    inside = region_mask(frames.shape[1:], region_px)
    return detect_in_frames(frames, lambda image: _dots(image, pixel_mm, inside), progress)


def _dots(image: AnyArray, pixel_mm: FloatArray, inside: BoolArray) -> tuple[FloatArray, FloatArray]:
    grey = finite_grey(image)
    contrast = ndimage.gaussian_filter(grey, _DOT_MM / pixel_mm)
    contrast -= ndimage.gaussian_filter(grey, _SURROUND_MM / pixel_mm, truncate=3.0)
    # Every seventh pixel: enough for the noise, in a seventh of the time.
    levels = contrast[inside]
    limit = max(_NOISE_SDS * robust_sigma(levels[::7]), _FAINTEST * float(levels.max()))
    near = np.ones(2 * np.maximum(np.rint(_APART_MM / pixel_mm), 1).astype(int) + 1, dtype=bool)
    features = extra_module("skimage.feature", "calibrate", "finding dots of wires")
    # A dot halfway between two pixels has two maxima, one beside the other.
    peaks = features.peak_local_max(contrast, 2, limit, exclude_border=False, footprint=near)
    peaks = peaks[inside[tuple(peaks.T)]]
    score = contrast[tuple(peaks.T)] - _along_lines(contrast, peaks, pixel_mm)
    best = np.argsort(-score, kind="stable")
    best = best[score[best] > limit][:_MOST_DOTS]
    if not best.size:
        raise InsufficientDataError("no dot")
    places = [bright_centre(grey, peak.astype(float), pixel_mm) for peak in peaks[best]]
    return np.array(places), score[best].astype(float)


def _along_lines(contrast: Float32Array, peaks: IntArray, pixel_mm: FloatArray) -> Float32Array:
    """Contrast of lines that peaks may be part of, shape (n,): the lesser of that on two opposite sides.

    Specular echoes, as of the floor or the phantom's frame, would otherwise be taken for rows of dots.
    """
    angle = np.linspace(0.0, np.pi, _ANGLES, endpoint=False)
    away = _LINE_REACH * _SURROUND_MM * np.column_stack([np.cos(angle), np.sin(angle)]) / pixel_mm
    sides = []
    for step in (away, -away):
        places = np.rint(peaks[:, None] + step).astype(int)
        inside = np.all((places >= 0) & (places < contrast.shape), axis=2)
        column, row = np.moveaxis(np.where(inside[..., None], places, 0), 2, 0)
        sides.append(np.where(inside, contrast[column, row], np.float32(0.0)))
    return np.asarray(np.minimum(*sides).max(axis=1, initial=0.0), dtype=np.float32)


def bright_centre(grey: Float32Array, pixel: FloatArray, pixel_mm: FloatArray) -> FloatArray:
    """Centre of brightness around a place, by mean shift.

    Filters see the tail of ringing under a wire as part of it: 0.4 mm, where the centre is 0.15 mm too deep.
    """
    reach = np.ceil(2.0 * _NEAR_MM / pixel_mm).astype(int)
    start = np.maximum(np.rint(pixel).astype(int) - reach, 0)
    stop = np.rint(pixel).astype(int) + reach + 1
    window = grey[start[0] : stop[0], start[1] : stop[1]]
    weight = np.maximum(window - np.median(window), 0.0) ** 2
    places = np.stack(np.meshgrid(*(np.arange(n) for n in window.shape), indexing="ij"), axis=-1) + start
    centre = pixel
    for _ in range(_SHIFTS):
        near = weight * np.exp(-0.5 * np.sum(((places - centre) * pixel_mm / _NEAR_MM) ** 2, axis=2))
        if not near.sum() > 0:
            return pixel
        centre = np.asarray(np.sum(places * near[..., None], axis=(0, 1)) / near.sum())
    return centre
