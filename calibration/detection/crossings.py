"""Places in images where two lines may cross, several to an image: wires that lie in the image's plane.

A line is brighter along its direction than to both of its sides. Where two cross, that holds for two
directions well apart; a bead, or a wire seen end on, is brighter in every direction. The lesser of the two
contrasts, with the greater, ranks the candidates; which of them is the crossing, the sensor's poses tell.

What stands still through the recording (lettering, the skin's reverberations, a step of gain) is taken off
first. Edges are no lines: they are brighter than one side only.

References
----------
.. [1] W. T. Freeman and E. H. Adelson, "The design and use of steerable filters", IEEE Trans. Pattern Anal.
   Mach. Intell., 1991 (responses over orientation tell junctions).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import fft, ndimage

from calibration.detection.dots import bright_centre
from calibration.detection.lines import peak_between
from calibration.detection.region import detect_in_frames, finite_grey, region_mask
from calibration.points import Detections
from speckle3d.core.arrays import AnyArray, BoolArray, Float32Array, FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.extras import extra_module
from speckle3d.core.progress import Progress
from speckle3d.core.sweep import Frames

_ORIENTATIONS = 16
_APART = 3
"""Least difference of the two lines' orientations, in steps of 11 degrees; filters themselves are 10 wide. Of
long wires in speckle, all 30 degrees apart are found, 25 apart three in four, 20 apart one in four."""
_LEAK = 0.2
"""Part of a lone line's contrast that filters well apart from it may see; taken off the second line's."""
_SIDE = 2.5
"""Where the two sides are, in `_WIDTH_MM`: beyond the line itself."""
_WIDTHS = (1.0, 2.0)
"""Filters across a line, in `_WIDTH_MM`."""
_STEPS = 1.8
"""Samples to a `_WIDTH_MM` of the images that are filtered."""
_GLANCES = 40
"""Frames compared to see what stands still."""
_FEWEST_GLANCES = 8
"""With fewer frames, wires may seem to stand still, too."""
_STANDING = 0.3
"""Part of the frames that are darker than what stands still; wires are in one place less often."""
_PEAKS = 40
"""Maxima looked at for each width."""


_WIDTH_MM, _LENGTH = 1.0, 6.0
"""Standard deviation of the finest filter across a line, and its length over its width."""
_APART_MM = 2.0
"""Of candidates nearer to each other than this, the strongest counts."""
_MOST_CANDIDATES = 6


def crossings_in_frames(
    frames: Frames,
    pixel_mm: FloatArray,
    region_px: npt.ArrayLike | None = None,
    progress: Progress | None = None,
) -> Detections:
    """Find candidates for a crossing in every frame, read one at a time, the likeliest of each first.

    Parameters
    ----------
    frames : Frames, shape (n, column, row)
    pixel_mm : ndarray, shape (2,)
        Distance between columns and between rows, mm; a third more or less does not matter.
    region_px : array_like, shape (k, 2), optional
        Corners (column, row) of a polygon outside which nothing counts.
    progress : callable, optional
        Called with the number of frames done and their total.

    Raises
    ------
    InvalidInputError
        If an argument is not what it must be.
    """
    inside, standing = region_mask(frames.shape[1:], region_px), standing_still(frames)
    return detect_in_frames(frames, lambda image: _crossings(image, pixel_mm, inside, standing), progress)


def standing_still(frames: Frames) -> Float32Array | None:
    """Grey level that each pixel exceeds in most frames, shape (column, row); None of few frames."""
    count = frames.shape[0]
    if count < _FEWEST_GLANCES:
        return None
    glances = np.unique(np.linspace(0, count - 1, _GLANCES).astype(int))
    levels = np.stack([frames[int(index)] for index in glances])
    place = int(_STANDING * (len(glances) - 1))
    levels.partition(place, axis=0)
    return np.asarray(levels[place], dtype=np.float32)


def _crossings(
    image: AnyArray,
    pixel_mm: FloatArray,
    inside: BoolArray,
    standing: Float32Array | None,
) -> tuple[FloatArray, FloatArray]:
    grey = finite_grey(image)
    if standing is not None:
        grey = grey - standing
    grey = np.where(inside, grey, np.float32(0.0))
    features = extra_module("skimage.feature", "calibrate", "finding crossings")
    places, scores = [], []
    for width in _WIDTH_MM * np.array(_WIDTHS):
        # On a grid fit for filters of this width.
        step_px = np.maximum(np.floor(width / _STEPS / pixel_mm), 1.0).astype(int)
        smooth = ndimage.gaussian_filter(grey, np.where(step_px > 1, 0.4 * step_px, 0.0))
        coarse = smooth[:: step_px[0], :: step_px[1]]
        response = _two_lines(coarse, step_px * pixel_mm, width)
        near = max(1, int(_APART_MM / 2.0 / float((step_px * pixel_mm).max())))
        peaks = features.peak_local_max(response, near, num_peaks=_PEAKS, exclude_border=False)
        between = [peak_between(response.T, *peaks.T[::-1]), peak_between(response, *peaks.T)]
        places.append((peaks + np.clip(between, -0.5, 0.5).T) * step_px)
        scores.append(response[tuple(peaks.T)])
    pixels, score = np.concatenate(places), np.concatenate(scores)
    column, row = np.minimum(np.rint(pixels).astype(int), np.array(grey.shape) - 1).T
    pixels, score = pixels[inside[column, row]], score[inside[column, row]]
    best: list[int] = []
    for k in np.argsort(-score, kind="stable"):
        away = np.linalg.norm((pixels[best] - pixels[k]) * pixel_mm, axis=1)
        if score[k] > 0 and (away >= _APART_MM).all() and len(best) < _MOST_CANDIDATES:
            best.append(int(k))
    if not best:
        raise InsufficientDataError("no lines that cross")
    return np.array([bright_centre(grey, p, pixel_mm) for p in pixels[best]]), score[best].astype(float)


def _two_lines(grey: Float32Array, step_mm: FloatArray, width_mm: float) -> Float32Array:
    """Geometric mean of the contrasts of the best line and of the best that is well apart from it."""
    pad = np.ceil(3.0 * _LENGTH * width_mm / step_mm).astype(int)
    shape = [fft.next_fast_len(n + 2 * margin, real=True) for n, margin in zip(grey.shape, pad, strict=True)]
    spectrum = fft.rfft2(np.pad(grey, [(n, n) for n in pad], mode="edge"), shape)
    along = np.pi * np.arange(_ORIENTATIONS) / _ORIENTATIONS
    frequency = [
        fft.fftfreq(shape[0], step_mm[0]).astype(np.float32)[:, None],
        fft.rfftfreq(shape[1], step_mm[1]).astype(np.float32)[None],
    ]
    lines = np.empty((_ORIENTATIONS, *grey.shape), np.float32)
    for number, angle in enumerate(along):
        cosine, sine = np.float32(np.cos(angle)), np.float32(np.sin(angle))
        length = 2.0 * (np.pi * _LENGTH * width_mm * (frequency[0] * cosine + frequency[1] * sine)) ** 2
        across = 2.0 * (np.pi * width_mm * (frequency[1] * cosine - frequency[0] * sine)) ** 2
        mean = fft.irfft2(spectrum * np.exp(-length - across), shape)
        shift = np.rint(_SIDE * width_mm * np.array([-sine, cosine]) / step_mm).astype(int)
        middle, left, right = (
            mean[p[0] : p[0] + grey.shape[0], p[1] : p[1] + grey.shape[1]]
            for p in (pad, pad + shift, pad - shift)
        )
        lines[number] = middle - np.maximum(left, right)
    best = lines.argmax(axis=0)
    second = np.zeros(grey.shape, np.float32)
    for number in range(_ORIENTATIONS):
        gap = np.abs(best - number)
        apart = np.minimum(gap, _ORIENTATIONS - gap) >= _APART
        np.maximum(second, lines[number], out=second, where=apart)
    first = np.maximum(lines.max(axis=0), 0.0)
    return np.asarray(np.sqrt(first * np.maximum(second - _LEAK * first, 0.0)))
