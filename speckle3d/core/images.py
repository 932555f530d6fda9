"""Images as NumPy, pictures and video have them, read as frames of a sweep, and their dynamic range.

The range of log-compressed images that nobody gives is estimated from their speckle. Where that is fully
developed, the 10th and the 90th percentile of its decibels lie 13.4 dB apart, whatever is scanned [1]_; how
many grey levels that is, the range says. Filters and compounding bring them nearer to each other, and their
distances from the median nearer to being equal: by that they are told, and what they leave open is the
range's standard deviation.

References
----------
.. [1] R. F. Wagner et al., "Statistics of speckle in ultrasound B-scans", IEEE Trans. Sonics Ultrason.,
   1983.
"""

from typing import Any

import numpy as np

from speckle3d.core.arrays import AnyArray, IntArray
from speckle3d.core.errors import InvalidInputError

LUMINANCE = np.array([0.299, 0.587, 0.114])
"""Of red, green and blue: ITU-R BT.601."""

_KINDS = ("uint8", "int16", "float32", "complex64")
"""Grey levels, echoes, and complex ones."""


USUAL_DB, USUAL_SIGMA = 60.0, 0.2
"""Range of scanners' presets, and its relative standard deviation: most have 45 to 80 dB."""
SINGLE_LOOK_DB = 13.4
"""From the 10th to the 90th percentile of an exponential variable's decibels: 10 lg(ln 0.1 / ln 0.9)."""
PATCH_MM = (3.6, 2.0)
"""Across and along the beam: some fifty cells of speckle, and less of structure than larger ones."""
USUAL_PIXEL_MM = 0.1
"""Of images of which nobody says how far apart their pixels are, and of fans."""
FRAMES, LEAST_PATCHES, QUIET = 10, 40, 0.3
"""Images and patches to look at, and the share of the brighter half of these, the least varied, that counts:
it holds least structure."""
SKEWNESS = (0.4, 0.8, 1.1, 1.3, 1.38, 1.46)
NARROWING = (2.0, 1.9, 1.75, 1.5, 1.15, 1.03)
NARROWING_SIGMA = (1.0, 0.5, 0.25, 0.17, 0.17, 0.05)
"""By the ratio of the distances of the 10th and the 90th percentile from the median: how much narrower grey
is than a single look's, and the relative standard deviation. Simulated phantoms and tissue of two physics
have 1.39 to 1.56 and are 0.99 to 1.08 times narrower; two looks 1.14 to 1.36 and 1.3 to 1.7; smoothed by
3 x 3 samples 0.6 to 1.1 and 1.5 to 2, with noise up to 2.9."""


IN_COLOUR = "pictures are in colour: taken as grey by luminance; what is drawn over the image stays"


class ImageFrames:
    """Frames (column, row) of images; colours become grey by luminance.

    Parameters
    ----------
    images : array, or what has its shape and dtype and gives one when indexed
        Shape (n, row, column), with an axis of 3 or 4 colours more or not.

    Raises
    ------
    InvalidInputError
        If the images are of another shape or type.
    """

    def __init__(self, images: Any) -> None:
        shape: tuple[int, ...] = images.shape
        kind: np.dtype[Any] = np.dtype(images.dtype)
        in_colour = shape[3:] in ((3,), (4,)) and kind == np.uint8
        if len(shape) != 3 + in_colour or 0 in shape or kind.name not in _KINDS:
            raise InvalidInputError(
                f"frames: expected images of shape (n, row, column) of {', '.join(_KINDS)}, or uint8 "
                f"(n, row, column, 3), got {shape} of {kind}"
            )
        self.any_thread = any_thread(images)
        self._images, self.dtype = images, kind.newbyteorder("=")
        self.shape = (shape[0], shape[2], shape[1])

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: int | slice) -> AnyArray:
        if isinstance(index, slice):
            return np.stack([self[i] for i in range(*index.indices(len(self)))])
        image = np.asarray(self._images[range(len(self))[index]])
        if image.shape[:2] != self.shape[:0:-1]:
            raise InvalidInputError(
                f"frame {index}: expected {self.shape[2]} rows of {self.shape[1]} columns, got {image.shape}"
            )
        if image.ndim == 3:
            image = np.rint(image[..., :3] @ LUMINANCE).astype(np.uint8)
        return np.ascontiguousarray(image.T, self.dtype)


def any_thread(images: object) -> bool:
    """Whether images may be read by several threads at once: arrays, and what says ``any_thread = True``."""
    return isinstance(images, np.ndarray) or getattr(images, "any_thread", False)


def spread_frames(count: int, most: int) -> IntArray:
    """Every frame of a short sweep, evenly spread ones of a long one, both ends included."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def estimate_dynamic_range(
    frames: Any, pitch_mm: float, spacing_mm: float, full_scale: float = 255.0
) -> tuple[float, float] | None:
    """Dynamic range of grey images and its standard deviation, dB; None of too few patches to tell.

    Parameters
    ----------
    frames : array, or what has its shape and gives a frame when indexed
        Grey levels, (frame, vector, sample); some are read.
    pitch_mm, spacing_mm : float
        Between vectors and between samples.
    """
    count, vectors, samples = frames.shape
    wide, high = max(3, round(PATCH_MM[0] / pitch_mm)), max(3, round(PATCH_MM[1] / spacing_mm))
    across, down = vectors // wide, samples // high
    if not across or not down:
        return None
    chosen = spread_frames(count, FRAMES).tolist()
    images = np.stack([frames[k][: across * wide, : down * high] for k in chosen])
    tiles = images.reshape(-1, across, wide, down, high)
    low, middle, high_level = np.percentile(tiles, (10, 50, 90), axis=(2, 4)).reshape(3, -1)
    fair = (low > 0) & (high_level < full_scale)
    if fair.sum() < LEAST_PATCHES:
        return None
    fair &= middle >= np.median(middle[fair])
    below, above = (middle - low)[fair], (high_level - middle)[fair]
    quiet = np.argsort(below + above)[: int(QUIET * below.size)]
    below, above = np.maximum(np.median([below[quiet], above[quiet]], axis=1), 0.5)
    narrowing, sigma = (np.interp(below / above, SKEWNESS, by) for by in (NARROWING, NARROWING_SIGMA))
    log_ratio = np.log(SINGLE_LOOK_DB * full_scale / (below + above) / narrowing / USUAL_DB)
    weight = USUAL_SIGMA**2 / (USUAL_SIGMA**2 + sigma**2)
    range_db = USUAL_DB * float(np.exp(weight * log_ratio))
    return range_db, range_db * float(np.sqrt(weight) * sigma)
