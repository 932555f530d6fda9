"""Frames on which speckle decorrelation cannot work, told by what is in the frame itself.

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

from __future__ import annotations

import enum
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import BModeSettings, RFSettings
from speckle3d.kernels.quality import patch_statistics
from speckle3d.matching.patches import PatchGrid

try:  # Ten times as fast.
    from isal.isal_zlib import crc32
except ImportError:
    from zlib import crc32

_LEAST_RATIO = 1e-11
"""Intensity in the band over the square of the frame's peak below which there is no echo: 16 bits end above
it, what single precision leaves of a constant (3e-13) below."""

_LEAST_COUNTS = 1.0
"""Intensity of integer samples below which an echo is lost in their rounding."""

_CONSTANT = 1e-4
"""Contrast of a patch up to which it is a constant, but for rounding. A step of grey in one pixel is 1e-3."""

_NOISY = 1 / 3
"""Share of patches with noise alone, in a frame without speckle, from which it is said to be lifted. Noise of
an amplifier is in all patches that hold no echo; only the name of the flag hangs on it."""

_DRAWN_SHARE, _DRAWN_OVER_SPECKLE, _DRAWN_FRAMES = 0.01, 10.0, 8
"""Share of a patch's pixels that no frame changes, from which something is drawn on it, also over that of the
median patch, and frames that must have been seen. Speckle that goes on by a quarter of a millimetre in all
has up to 0.02 of such pixels, by more none."""

_LISTED = 8
"""Frames named in a line of `describe`."""


class FrameFlag(enum.IntFlag):
    """Why a frame is not to be trusted."""

    FROZEN = 1
    """Bit for bit the frame before: the recorder repeated it."""
    SATURATED = 2
    """Too many samples clipped."""
    LIFTED = 4
    """No contact: below the near field noise or reverberation alone, or far less echo than elsewhere."""
    NO_SPECKLE = 8
    """A signal without the statistics of speckle, or none."""
    UNMATCHED = 16
    """Shares too little speckle with any earlier frame; set where frames are matched."""


_WORDS = {
    FrameFlag.FROZEN: "frozen",
    FrameFlag.SATURATED: "saturated",
    FrameFlag.LIFTED: "with the probe lifted",
    FrameFlag.NO_SPECKLE: "without speckle",
    FrameFlag.UNMATCHED: "unlike any earlier frame",
}


class QualitySettings(BaseModel):
    """What is asked of a patch and of a frame; in comments what was measured to set it."""

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
    # Sound frames lose 0.3 dB in all of the rows asked; lifted ones what speckle is above noise, 37 dB here.
    drop_db: float = Field(
        10.0, gt=0, description="Loss of echo below the near field at which the probe is taken to be lifted."
    )


@dataclass(frozen=True)
class FrameFeatures:
    """What is kept of a frame; r rows of patches."""

    digest: int
    """Of the samples as read: a frame that repeats the one before has the same."""
    clipped: float
    """Share of samples piled up at the frame's own extremes, over the share at which it is saturated."""
    samples_db: float
    """Mean square of the samples as read below the topmost row, in the band or not."""
    near_db: float
    """Mean intensity above the patches; NaN where there is nothing above them."""
    level_db: FloatArray
    """Mean intensity of each row, shape (r,)."""
    speckle: FloatArray
    """Share of patches with speckle in each row, shape (r,); columns all black do not count."""
    noise_share: float
    """Share of patches that vary as speckle does but have nothing in common from vector to vector."""
    usable: BoolArray
    """Patches that hold an echo which varies as speckle or structure does, shape (p,): no shadow, no noise
    alone, none without contact or saturated."""

    @property
    def speckle_share(self) -> float:
        """Share of patches with speckle in the frame."""
        return float(self.speckle.mean())


class FrameInspector:
    """Looks at the frames of one sweep, each by itself and in any order.

    Parameters
    ----------
    signal : RFSettings or BModeSettings
    patches : PatchGrid
        On the grid of the intensity images.
    """

    def __init__(
        self, signal: RFSettings | BModeSettings, patches: PatchGrid, settings: QualitySettings | None = None
    ) -> None:
        self.settings = settings or QualitySettings()
        self._bmode = isinstance(signal, BModeSettings)
        self._columns = int(np.unique(patches.first[:, 0]).size)
        self._first, self._size, self._inside = patches.first, patches.size, patches.inside
        self._pitch_mm = float(patches.spacing_mm[0])

    def inspect(self, frame: npt.NDArray[Any], intensity: Float32Array) -> FrameFeatures:
        """Describe one frame.

        Parameters
        ----------
        frame : ndarray, shape (vector, sample)
            As read: RF, analytic (I/Q) or grey levels.
        intensity : ndarray, shape (vector, grid.samples)
            Its echo intensity, not equalised.

        Raises
        ------
        InvalidInputError
            If the intensity image does not hold the patches.
        """
        samples = np.ascontiguousarray(frame)
        if np.iscomplexobj(samples):
            samples = samples.view(samples.real.dtype)
        # Every eighth vector tells how strong samples as read are, and whether they are counts. Those of I/Q
        # are, if they come from pairs of integers.
        some = samples[::8]
        counted = samples.dtype.kind in "iu" or bool((some == np.rint(some)).all())
        floor, clipped = self._rails(samples, counted)
        with np.errstate(all="ignore"):  # Flat patches, and samples that are not finite, come out as NaN.
            statistics = self._statistics(intensity)
            mean = statistics[0]
            speckle, noise, usable, live = self._classify(statistics, floor)
            # A sample that is not finite spoils its whole vector, and equalising then the others.
            finite = np.isfinite(intensity.sum())
            speckle &= finite
            near = intensity[:, : self._first[0, 1]]
            top = (self._first[0, 1] + self._size[1]) * samples.shape[1] // intensity.shape[1]
            below = some[:, top:].astype(np.float32)
            return FrameFeatures(
                digest=_digest(samples),
                clipped=clipped,
                samples_db=float(_decibel(np.mean(below * below))),
                near_db=float(_decibel(near.mean())) if near.size else np.nan,
                level_db=_decibel(mean[live].mean(axis=0)),
                speckle=self._share_inside(speckle, live),
                noise_share=float(self._share_inside(noise, live).mean()),
                usable=(usable & finite).ravel() & self._inside,
            )

    def _share_inside(self, chosen: BoolArray, live: BoolArray) -> FloatArray:
        """Share of the patches in the region, columns all black aside, that are chosen in each row."""
        inside = self._inside.reshape(chosen.shape) & live[:, None]
        return np.asarray((chosen & inside).sum(axis=0) / np.maximum(inside.sum(axis=0), 1))

    def _rails(self, samples: npt.NDArray[Any], counted: bool) -> tuple[float, float]:
        """Intensity below which there is no echo, and clipping over its limit."""
        lowest, highest = samples.min(axis=1), samples.max(axis=1)
        low, high = float(lowest.min()), float(highest.max())
        # Only vectors that come within a count of an extreme can hold what is counted there.
        clipped = _at_rail(samples[highest >= high - 1], high, -1, counted, samples.size)
        if self._bmode:
            # Black is no echo: it is neither clipped nor counted.
            return 0.0, clipped / max(int(np.count_nonzero(samples)), 1) / self.settings.clipped_bmode
        clipped += _at_rail(samples[lowest <= low + 1], low, 1, counted, samples.size)
        least = _LEAST_COUNTS if counted else 0.0
        floor = max(least, _LEAST_RATIO * max(abs(low), abs(high)) ** 2)
        return floor, clipped / samples.size / self.settings.clipped_rf

    def _statistics(self, intensity: Float32Array) -> FloatArray:
        """Mean, contrast and three correlations of the patches, shape (5, column, row)."""
        needed = self._first.max(axis=0) + self._size
        if (intensity.shape < needed).any():
            raise InvalidInputError(
                f"expected an intensity image of at least {needed[0]} x {needed[1]} samples, got "
                f"{' x '.join(map(str, intensity.shape))}"
            )
        found = np.empty((self._first.shape[0], 5))
        image = np.ascontiguousarray(intensity, dtype=np.float32)
        patch_statistics(image, self._first, self._size, found)
        return np.moveaxis(found.reshape(self._columns, -1, 5), 2, 0)

    def _classify(
        self, statistics: FloatArray, floor: float
    ) -> tuple[BoolArray, BoolArray, BoolArray, BoolArray]:
        """Patches with speckle, with noise, usable, shape (column, row); columns that hold anything."""
        s = self.settings
        mean, contrast, alike, across, along = statistics
        echo = (mean > floor) & (contrast > s.least_contrast)
        fine = (across < s.halves_correlation) & (along < s.halves_correlation)
        together = (alike > s.neighbour_correlation) | (self._pitch_mm > s.neighbour_pitch_mm)
        varies: BoolArray = contrast > _CONSTANT
        live = np.asarray(varies.any(axis=1) | ~varies.any())
        return echo & together & fine, echo & ~together, echo & together, live


class DrawnOver:
    """Patches on which something is drawn that no frame changes: text, a ruler, a logo.

    Parameters
    ----------
    patches : PatchGrid
    """

    def __init__(self, patches: PatchGrid) -> None:
        self._patches = patches
        self._lock = threading.Lock()
        self._frames = 0
        self._darkest: npt.NDArray[Any] | None = None
        self._brightest: npt.NDArray[Any] | None = None

    def keep(self, frame: npt.NDArray[Any]) -> None:
        """Look at one frame of grey levels, on any thread."""
        with self._lock:
            self._frames += 1
            if self._darkest is None or self._brightest is None:
                self._darkest, self._brightest = frame.copy(), frame.copy()
            else:
                np.minimum(self._darkest, frame, out=self._darkest)
                np.maximum(self._brightest, frame, out=self._brightest)

    @property
    def patches(self) -> BoolArray:
        """Which patches something is drawn on, shape (p,)."""
        none = np.zeros(len(self._patches), dtype=bool)
        if self._darkest is None or self._frames < _DRAWN_FRAMES:
            return none
        fixed = (self._darkest == self._brightest) & (self._darkest > 0)
        wide, high = self._patches.size
        share = np.array([fixed[v : v + wide, s : s + high].mean() for v, s in self._patches.first])
        # Where the probe hardly moves, speckle agrees here and there, but all over the image.
        return np.asarray(share > max(_DRAWN_SHARE, _DRAWN_OVER_SPECKLE * float(np.median(share))))


def _digest(samples: npt.NDArray[Any]) -> int:
    """Digest bit for bit; of another frame the same once in four thousand million."""
    return int(crc32(samples.data))


def flag_frames(features: Sequence[FrameFeatures], settings: QualitySettings | None = None) -> IntArray:
    """Judge the frames of a sweep, levels against the sweep itself, the rest by itself.

    Parameters
    ----------
    features : sequence of FrameFeatures, length n
        Of every frame, in order.

    Returns
    -------
    ndarray of int, shape (n,)
        Each a `FrameFlag`; zero for a frame with which nothing is wrong.
    """
    if not features:
        return np.zeros(0, dtype=np.int64)
    s = settings or QualitySettings()
    saturated = np.array([f.clipped >= 1 for f in features])
    few = np.array([f.speckle_share < s.speckle_share for f in features])
    noisy = np.array([f.noise_share > _NOISY for f in features])
    lifted = (few & noisy) | _darkened(features, few, ~saturated & ~few, s.drop_db)
    flags = np.zeros(len(features), dtype=np.int64)
    repeated = [frame.digest == before.digest for before, frame in pairwise(features)]
    flags[1:][repeated] |= FrameFlag.FROZEN
    flags[saturated] |= FrameFlag.SATURATED
    flags[lifted] |= FrameFlag.LIFTED
    flags[few & ~lifted] |= FrameFlag.NO_SPECKLE
    return flags


def describe(flags: npt.ArrayLike) -> list[str]:
    """Tell the flagged frames, a line for every kind of flag: how many, and the first of them."""
    values = np.asarray(flags, dtype=np.int64)
    lines = []
    for flag, words in _WORDS.items():
        frames = np.flatnonzero(values & int(flag)).tolist()
        if frames:
            more = f" and {len(frames) - _LISTED} more" if len(frames) > _LISTED else ""
            named = ", ".join(map(str, frames[:_LISTED]))
            lines.append(f"{len(frames)} frame{'s' * (len(frames) > 1)} {words}: {named}{more}")
    return lines


def _darkened(
    features: Sequence[FrameFeatures], few: BoolArray, sound: BoolArray, drop_db: float
) -> BoolArray:
    """Frames whose echoes are far below those of the better half of the sound frames.

    Of the rows that hold speckle there, the topmost may still hold ring-down, and the lower half a bone's
    shadow or little but noise; these are not asked, and the others must all have lost it, and by more than
    the near field: a gain turned down takes that along, a lifted probe leaves its ring-down. With too few
    patches of speckle the samples as read must be fainter too: those of a constant are not.
    """
    nothing = np.zeros(len(features), dtype=bool)
    if not sound.any():
        return nothing
    level = np.stack([f.level_db for f in features])
    overall = level.mean(axis=1)
    better = sound & (overall >= np.median(overall[sound]))
    speckle = np.stack([f.speckle for f in features])
    rows = np.flatnonzero(np.median(speckle[better], axis=0) >= 0.5)
    rows = rows[1 : 1 + rows.size // 2]
    if not rows.size:
        return nothing

    def loss(values: FloatArray) -> FloatArray:
        return np.asarray(np.median(values[better], axis=0) - values)

    darker = loss(level[:, rows]).min(axis=1)
    fainter = loss(np.array([f.samples_db for f in features]))
    beyond_near = darker - loss(np.array([f.near_db for f in features]))
    return np.asarray((darker > drop_db) & (beyond_near > drop_db) & (~few | (fainter > drop_db)))


def _at_rail(samples: npt.NDArray[Any], rail: float, inwards: int, counted: bool, of: int) -> int:
    """Samples at an extreme of the frame, which has `of` samples, less those one count inside it.

    Clipping piles samples up at the rail; without it there are fewer at the extreme than next to it, however
    few the counts. A constant frame has no rail.
    """
    at = np.count_nonzero(samples == samples.dtype.type(rail)) if np.isfinite(rail) else 0
    if at in (1, of):
        return 0
    beside: int = 0
    if counted:
        beside = int(np.count_nonzero(samples == samples.dtype.type(rail + inwards)))
    return max(int(at) - beside, 0)


def _decibel(power: npt.ArrayLike) -> FloatArray:
    """Finite whatever comes in: nothing, and what is not a number, is far below everything."""
    return np.asarray(10 * np.log10(np.fmin(np.fmax(power, 1e-38), 1e38)), dtype=float)
