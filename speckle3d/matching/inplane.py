"""In-plane motion of patches and of the whole frame, sub-sample in both directions.

The shift comes from all patches together, and the correlation is read at that shift: taking each patch's own
maximum over lags biases the correlation upward and distances short.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field
from scipy import fft

from speckle3d.core.arrays import BoolArray, Complex64Array, Float32Array, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import ImageGrid
from speckle3d.core.threads import in_parallel
from speckle3d.kernels.inplane import REFERENCES, Geometry, Matches, match_pairs
from speckle3d.matching.patches import PatchGrid

_NO_ECHO = np.empty((2, 0, 0), dtype=np.float32)


class InPlaneSettings(BaseModel):
    """How in-plane motion is searched."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    search_mm: float = Field(3.0, gt=0, description="Largest in-plane shift looked for between two frames.")
    least_overlap: float = Field(
        0.6, gt=0, le=1, description="Share of a patch that must still lie in the other image."
    )


@dataclass(frozen=True)
class InPlaneMotion:
    """Motion of the second frame in the first frame's plane, about the image's centre.

    Attributes
    ----------
    x_mm, y_mm : float
        Displacement of the image's centre.
    roll_rad : float
    covariance : ndarray, shape (3, 3)
        Of (x, y, roll).
    """

    x_mm: float = 0.0
    y_mm: float = 0.0
    roll_rad: float = 0.0
    covariance: FloatArray | None = None


def compose(first: InPlaneMotion, then: InPlaneMotion) -> InPlaneMotion:
    """In-plane motion over two steps, as a start for matching across both."""
    c, s = np.cos(first.roll_rad), np.sin(first.roll_rad)
    return InPlaneMotion(
        first.x_mm + c * then.x_mm - s * then.y_mm,
        first.y_mm + s * then.x_mm + c * then.y_mm,
        first.roll_rad + then.roll_rad,
    )


def inverse(motion: InPlaneMotion) -> InPlaneMotion:
    """In-plane motion the other way round."""
    c, s = np.cos(motion.roll_rad), np.sin(motion.roll_rad)
    return InPlaneMotion(
        -c * motion.x_mm - s * motion.y_mm, s * motion.x_mm - c * motion.y_mm, -motion.roll_rad
    )


@dataclass(frozen=True)
class MatchedPair:
    """What two frames' patches have in common once in-plane motion is taken out.

    Attributes
    ----------
    correlation : ndarray, shape (p,)
        Of intensity, or the squared magnitude of the complex echo's, at the frame's in-plane shift; NaN where
        a patch left the image or is flat.
    median : float
        Of the correlations; zero if there is none.
    motion : InPlaneMotion
    """

    correlation: FloatArray
    median: float
    motion: InPlaneMotion

    def laid_out(self, patches: BoolArray) -> MatchedPair:
        """Correlations of all patches, NaN but for those that were matched, shape (p,)."""
        if patches.all():
            return self
        correlation = np.full(patches.size, np.nan)
        correlation[patches] = self.correlation
        return replace(self, correlation=correlation)

    def among(self, usable: BoolArray) -> MatchedPair:
        """Keep the correlations of some patches."""
        if usable.all():
            return self
        correlation = np.where(usable, self.correlation, np.nan)
        known = correlation[np.isfinite(correlation)]
        return replace(self, correlation=correlation, median=float(np.median(known)) if known.size else 0.0)


class CoarseMatcher:
    """Whole-frame cross-correlation by FFT: the shift to the nearest sample, without a first guess."""

    def __init__(self, grid: ImageGrid, search_mm: float) -> None:
        # Intensity comes with two to four samples in a speckle: two may be pooled, and the peak is still
        # found to the sample from which the matching goes on.
        self._pool = 2 if grid.sample_spacing_mm < 0.05 else 1
        self._reach = (
            int(np.ceil(search_mm / grid.vector_pitch_mm)),
            int(np.ceil(search_mm / (grid.sample_spacing_mm * self._pool))),
        )
        rows = min(self._reach[0], grid.vectors - 1)
        columns = min(self._reach[1], grid.samples // self._pool - 1)
        self._reach = (rows, columns)
        self._shape = (
            fft.next_fast_len(grid.vectors + rows, real=True),
            fft.next_fast_len(grid.samples // self._pool + columns, real=True),
        )

    def spectrum(self, image: Float32Array) -> Complex64Array:
        """Transform one frame; keep the result for every pair the frame is in."""
        usable = image.shape[1] // self._pool * self._pool
        # Not `numpy.mean`, which takes fourteen times as long along so short an axis.
        pooled = sum(
            (image[:, k : usable : self._pool] for k in range(1, self._pool)), image[:, : usable : self._pool]
        )
        pooled = pooled / np.float32(self._pool)
        pooled -= pooled.mean()
        return np.asarray(fft.rfft2(pooled, self._shape))

    def shift(self, fixed: Complex64Array, moving: Complex64Array) -> npt.NDArray[np.int64]:
        """Vectors and samples by which `moving` is displaced, shape (2,)."""
        rows, columns = self._reach
        product = fft.ifft(np.conj(fixed) * moving, axis=0, overwrite_x=True)[np.arange(-rows, rows + 1)]
        near = fft.irfft(product, self._shape[1], axis=1)[:, np.arange(-columns, columns + 1)]
        peak = np.unravel_index(np.argmax(near), near.shape)
        return np.array([peak[0] - rows, (peak[1] - columns) * self._pool], dtype=np.int64)


def match_with_each(
    fixed: Sequence[Float32Array],
    moving: Float32Array,
    patches: PatchGrid,
    starts: Sequence[InPlaneMotion],
    centre_mm: FloatArray,
    settings: InPlaneSettings | None = None,
    echoes: tuple[Sequence[Float32Array], Float32Array] | None = None,
    wavenumber_per_mm: float = 0.0,
) -> list[MatchedPair]:
    """Find the in-plane motion of a frame against each of some others, and the correlations left at it.

    Parameters
    ----------
    fixed : sequence of ndarray of float32, shape (vector, sample)
        Equalised intensity of the others.
    moving : ndarray of float32, shape (vector, sample)
        The frame's.
    patches : PatchGrid
    starts : sequence of InPlaneMotion
        Right to about a sample, e.g. from `CoarseMatcher` or from the step before.
    centre_mm : ndarray, shape (3,)
        The image's centre.
    echoes : tuple, optional
        Real and imaginary parts of the others' demodulated echoes and of the frame's, each of shape
        (2, vector, sample), to be correlated instead of intensity.
    wavenumber_per_mm : float
        Two-way, of the demodulation: what turns in the plane and strain do to their phase is undone.

    References
    ----------
    .. [1] Housden et al., "Subsample interpolation strategies for sensorless freehand 3D ultrasound",
       Ultrasound Med. Biol. 32(12), 2006: sub-sample lateral motion must not read as elevation.
    """
    for image in fixed:
        if image.shape != moving.shape:
            raise InvalidInputError(f"expected two frames of one shape, got {image.shape} and {moving.shape}")
    s = settings or InPlaneSettings()
    count, size = len(fixed), len(patches)
    geometry = Geometry(
        patches.first,
        patches.size,
        patches.centre_mm - centre_mm[:2],
        patches.spacing_mm,
        s.least_overlap,
        echoes is not None,
        float(wavenumber_per_mm),
    )
    matches = Matches(
        np.empty((count, size)),
        np.empty((count, 4, 3)),
        np.empty(count),
        np.empty(count, dtype=np.bool_),
    )
    matches.motion[:, 0] = [(start.x_mm, start.y_mm, start.roll_rad) for start in starts]
    theirs, ours = echoes or ([_NO_ECHO] * count, _NO_ECHO)

    def match(first: int, stop: int) -> None:
        for begin in range(first, stop, REFERENCES):
            end = min(begin + REFERENCES, stop)
            images, parts = _filled(fixed[begin:end]), _filled(theirs[begin:end])
            match_pairs(images, parts, moving, ours, geometry, matches, begin, end)

    in_parallel(match, count)
    return [_match(matches, k) for k in range(count)]


def _filled(frames: Sequence[Float32Array]) -> tuple[Float32Array, ...]:
    """As many frames as the kernel takes, the last repeated."""
    return (*frames, *[frames[-1]] * (REFERENCES - len(frames)))


def _match(matches: Matches, row: int) -> MatchedPair:
    x, y, roll = matches.motion[row, 0].tolist()
    covariance = matches.motion[row, 1:] if matches.fitted[row] else None
    motion = InPlaneMotion(x, y, roll, covariance)
    return MatchedPair(matches.correlation[row], float(matches.median[row]), motion)
