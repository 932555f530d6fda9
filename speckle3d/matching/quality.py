"""Quality of single frames: speckle, clipping, contact, repeated frames.

A patch is taken for speckle when its intensity varies as speckle does (its contrast, standard deviation over
mean, is 1 where speckle is fully developed [1]_ and more beside reflectors), neighbouring vectors agree (the
beam is wider than their pitch; electronic noise differs from vector to vector) and its halves do not (speckle
is finer than a patch; reverberation, layers, ramps and shading are not). A frame needs a share of such
patches.

References
----------
.. [1] R. F. Wagner et al., "Statistics of speckle in ultrasound B-scans", IEEE Trans. Sonics Ultrason.,
   1983.
"""

import enum
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field
from scipy.ndimage import label

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from speckle3d.matching.patches import PatchGrid

_SAMPLES = 40
"""Samples in depth of which a patch's statistics are taken at least, where it has more: speckle has four."""

LONGEST_REPEAT = 4
"""Repeats of a frame in a row by a recorder that is faster than the scanner, as 60 frames/s for 12. While
more are written the probe may be anywhere."""


class FrameFlag(enum.IntFlag):
    """Why a frame is not to be trusted."""

    FROZEN = 1
    """Bit for bit the frame before: the recorder repeated it."""
    SATURATED = 2
    """Too many samples clipped."""
    LIFTED = 4
    """No contact: noise alone, below the near field."""
    NO_SPECKLE = 8
    """A signal without the statistics of speckle, or none."""
    UNMATCHED = 16
    """Shares too little speckle with any earlier frame; set where frames are matched."""


class QualitySettings(BaseModel):
    """Thresholds for the quality of patches and frames; comments give their origin."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    # One patch in a hundred of simulated speckle is below 0.83, of a mouse's liver below 1.06.
    least_contrast: float = Field(
        0.5, ge=0, description="Intensity's standard deviation over its mean in a patch of speckle, at least."
    )
    # One in a hundred: noise above 0.13; simulated speckle at 0.3 mm below 0.41, the mouse's below 0.17.
    neighbour_correlation: float = Field(
        0.2, ge=-1, lt=1, description="Correlation of neighbouring vectors in a patch of speckle, at least."
    )
    # At 0.6 mm half of the patches of simulated speckle would pass for noise, at 0.9 mm most.
    neighbour_pitch_mm: float = Field(
        0.5, ge=0, description="Vector pitch beyond which neighbours are not asked: the beam is no wider."
    )
    # One in a hundred of phantom and mouse is above 0.36; reverberation is at 0.7 to 1.
    halves_correlation: float = Field(
        0.5, gt=0, le=1, description="Correlation of a speckle patch's halves, either way, at most."
    )
    # B-mode of bone and spine holds 0.41 or more, simulated tissue 0.63; wires and water floors up to 0.09, a
    # lifted probe whose first 3 mm stay up to 0.08.
    speckle_share: float = Field(
        0.15, ge=0, le=1, description="Share of patches with speckle that a frame needs."
    )
    # Clipping takes correlation away: about here the median patch of tissue reads its distance 1.5 % too long
    # (in B-mode 2 %), the mean over patches 7 %. Unclipped RF has up to 2e-5, real B-mode 2e-3.
    clipped_rf: float = Field(
        0.02, gt=0, le=1, description="Share of clipped RF samples at which a frame is saturated."
    )
    clipped_bmode: float = Field(
        0.05, gt=0, le=1, description="Share of clipped B-mode samples at which a frame is saturated."
    )


@dataclass(frozen=True)
class FrameFeatures:
    """Quality features of one frame."""

    contrast: FloatArray
    """Standard deviation of intensity over its mean, shape (p,): a frame that repeats the one before has the
    same."""
    lateral: FloatArray
    """Correlation of neighbouring vectors, shape (p,)."""
    clipped: float
    """Share of samples at the frame's own extremes, over the share at which it is saturated."""
    speckle_share: float
    """Share of patches with speckle; columns all black do not count."""
    noise_share: float
    """Share of patches that vary as speckle does but have nothing in common from vector to vector."""
    grey_spread: FloatArray
    """Logarithm of the standard deviation of each patch's grey levels, shape (p,); NaN of echoes."""
    usable: BoolArray
    """Patches that hold an echo which varies as speckle or structure does, shape (p,): no shadow, no noise
    alone, none without contact or saturated."""


def inspect_frame(
    frame: npt.NDArray[Any],
    intensity: Float32Array,
    patches: PatchGrid,
    is_bmode: bool,
    settings: QualitySettings | None = None,
) -> FrameFeatures:
    """Describe one frame by itself.

    Parameters
    ----------
    frame : ndarray, shape (vector, sample)
        As read: RF, analytic (I/Q) or grey levels.
    intensity : ndarray, shape (vector, grid.samples)
        Its echo intensity, not equalised.
    patches : PatchGrid
        On the grid of the intensity images.
    """
    s = settings or QualitySettings()
    inside, step = patches.inside, max(1, int(patches.size[1]) // _SAMPLES)
    tiles = patches.tiles(intensity, step)
    wide, high = tiles.shape[1] // 2, tiles.shape[2] // 2
    with np.errstate(divide="ignore", invalid="ignore"):  # Of flat patches.
        tiles = tiles / tiles.mean(axis=(1, 2), keepdims=True) - np.float32(1.0)
        contrast, alike = tiles.std(axis=(1, 2)), correlation(tiles[:, :-1], tiles[:, 1:])
        across = correlation(tiles[:, :wide], tiles[:, -wide:])
        along = correlation(tiles[..., :high], tiles[..., -high:])
    # A sample that is not finite spoils its whole vector, and equalising then the others.
    echo = (contrast > s.least_contrast) & np.isfinite(intensity.sum())
    together = (alike > s.neighbour_correlation) | (patches.spacing_mm[0] > s.neighbour_pitch_mm)
    fine = (across < s.halves_correlation) & (along < s.halves_correlation)
    varies = patches.rows_of(np.ptp(tiles, axis=(1, 2)) > 0.0)
    countable = inside & np.repeat(varies.any(axis=0), len(varies))

    def share(mask: BoolArray) -> float:
        return float((echo & mask & countable).sum() / max(int(countable.sum()), 1))

    usable, spread = echo & together & inside, np.full(len(patches), np.nan)
    if is_bmode:
        with np.errstate(divide="ignore"):  # Black patches have none.
            spread = np.log(patches.tiles(frame, 4 * step).std(axis=(1, 2), dtype=np.float64))
    shares = share(together & fine), share(~together)
    return FrameFeatures(contrast, alike, _clipping(frame, is_bmode, s), *shares, spread, usable)


def correlation(a: Float32Array, b: Float32Array) -> FloatArray:
    """Pearson's coefficient of each patch, shape (p, v, s), with the same of `b`; NaN where flat."""
    a, b = (part - part.mean(axis=(1, 2), keepdims=True) for part in (a, b))
    product, power, others = (np.einsum("pvs,pvs->p", *pair) for pair in ((a, b), (a, a), (b, b)))
    return np.asarray(product / np.sqrt(power * others), dtype=float)


def _clipping(frame: npt.NDArray[Any], is_bmode: bool, settings: QualitySettings) -> float:
    """Share of samples at a frame's extremes over its limit; a constant frame has none."""
    samples = np.ascontiguousarray(frame).view(frame.real.dtype)
    low, high = samples.min(), samples.max()
    if low == high:
        return 0.0
    count = np.count_nonzero(samples == high)
    if is_bmode:  # Black is no echo: it is neither clipped nor counted.
        return count / np.count_nonzero(samples) / settings.clipped_bmode
    return (count + np.count_nonzero(samples == low)) / samples.size / settings.clipped_rf


def short_repeats(flags: IntArray) -> BoolArray:
    """Frames with the image of the one before, in short runs, shape (n,)."""
    run, _ = label(flags & FrameFlag.FROZEN)
    return np.asarray((run > 0) & (np.bincount(run) <= LONGEST_REPEAT)[run])


def flag_frames(features: Sequence[FrameFeatures], settings: QualitySettings | None = None) -> IntArray:
    """Judge the frames of a sweep, each by itself but for repeated ones.

    Parameters
    ----------
    features : sequence of FrameFeatures, length n
        Of every frame, in order.

    Returns
    -------
    ndarray of int, shape (n,)
        Each a `FrameFlag`; zero for a frame with which nothing is wrong.
    """
    s = settings or QualitySettings()
    flags = np.zeros(len(features), dtype=np.int64)
    repeats = [np.array_equal(frame.contrast, before.contrast, True) for before, frame in pairwise(features)]
    flags[1:][repeats] |= FrameFlag.FROZEN
    for k, frame in enumerate(features):
        if frame.clipped >= 1:
            flags[k] |= FrameFlag.SATURATED
        if frame.speckle_share < s.speckle_share:
            # Noise of an amplifier is in most patches, if none holds an echo.
            flags[k] |= FrameFlag.LIFTED if frame.noise_share > 1 / 2 else FrameFlag.NO_SPECKLE
    return flags
