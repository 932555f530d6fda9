"""In-plane motion of patches and of the whole frame, sub-sample in both directions.

The shift comes from all patches together, and the correlation is read at that shift: taking each patch's own
maximum over lags biases the correlation upward and distances short.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field
from scipy import fft

from speckle3d.core.arrays import Complex64Array, Float32Array, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.leastsquares import MAD_TO_SIGMA, huber_weights
from speckle3d.core.sweep import ImageGrid
from speckle3d.kernels.correlation import patch_coherences, patch_correlations
from speckle3d.matching.patches import PatchGrid

LEAST_CORRELATION = 0.05
"""Below this at any lag, the logarithm is mostly noise; the parabola is then put through the coefficient."""


class InPlaneSettings(BaseModel):
    """How in-plane motion is searched."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    search_mm: float = Field(3.0, gt=0, description="Largest in-plane shift looked for between two frames.")
    least_overlap: float = Field(
        0.6, gt=0, le=1, description="Share of a patch that must still lie in the other image."
    )
    interpolate: bool = Field(
        True, description="Read correlations between samples; false: at the nearest, for comparison."
    )
    passes: int = Field(2, ge=1, le=5, description="How often lags are centred anew on the fitted motion.")


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


@dataclass(frozen=True)
class PatchMatch:
    """What two frames' patches have in common once in-plane motion is taken out.

    Attributes
    ----------
    correlation : ndarray, shape (p,)
        Of intensity, or the squared magnitude of the complex echo's, at the frame's in-plane shift; NaN where
        a patch left the image or is flat.
    shift_mm : ndarray, shape (p, 2)
        Each patch's own shift, lateral and axial; NaN where it has no peak.
    motion : InPlaneMotion
    """

    correlation: FloatArray
    shift_mm: FloatArray
    motion: InPlaneMotion


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
        pooled = image[:, :usable].reshape(image.shape[0], -1, self._pool).mean(axis=2)
        pooled -= pooled.mean()
        return np.asarray(fft.rfft2(pooled, self._shape))

    def shift(self, fixed: Complex64Array, moving: Complex64Array) -> npt.NDArray[np.int64]:
        """Vectors and samples by which `moving` is displaced, shape (2,)."""
        product = fft.irfft2(np.conj(fixed) * moving, self._shape)
        rows, columns = self._reach
        near = product[np.arange(-rows, rows + 1)[:, None], np.arange(-columns, columns + 1)]
        peak = np.unravel_index(np.argmax(near), near.shape)
        return np.array([peak[0] - rows, (peak[1] - columns) * self._pool], dtype=np.int64)


def match_patches(
    fixed: Float32Array,
    moving: Float32Array,
    patches: PatchGrid,
    start: InPlaneMotion,
    centre_mm: FloatArray,
    settings: InPlaneSettings | None = None,
    echoes: tuple[Float32Array, Float32Array] | None = None,
    wavenumber_per_mm: float = 0.0,
) -> PatchMatch:
    """Find the in-plane motion between two frames and the correlation left at it.

    Parameters
    ----------
    fixed, moving : ndarray of float32, shape (vector, sample)
        Equalised intensity.
    patches : PatchGrid
    start : InPlaneMotion
        Right to about a sample, e.g. from `CoarseMatcher` or from the step before.
    centre_mm : ndarray, shape (3,)
        The image's centre.
    echoes : tuple of ndarray of float32, shape (2, vector, sample), optional
        Real and imaginary parts of both frames' demodulated echoes, to be correlated instead of intensity.
    wavenumber_per_mm : float
        Two-way, of the demodulation: what turns in the plane and strain do to their phase is undone.

    References
    ----------
    .. [1] Housden et al., "Subsample interpolation strategies for sensorless freehand 3D ultrasound",
       Ultrasound Med. Biol. 32(12), 2006: sub-sample lateral motion must not read as elevation.
    """
    if fixed.shape != moving.shape:
        raise InvalidInputError(f"expected two frames of one shape, got {fixed.shape} and {moving.shape}")
    s = settings or InPlaneSettings()
    at = patches.centre_mm - centre_mm[:2]
    predicted, strain = _shift_field(start, at), np.zeros(2)
    place = (patches.first, patches.size)
    for _ in range(s.passes):
        lag = np.rint(predicted / patches.spacing_mm).astype(np.int64)
        rho = np.empty((len(patches), 3, 3))
        patch_correlations(fixed, moving, *place, lag, s.least_overlap, rho, echoes is None)
        shift, weight = _patch_peaks(rho, lag, patches)
        motion, predicted, strain = _fit_motion(shift, weight, at, start, predicted)
        if np.array_equal(np.rint(predicted / patches.spacing_mm), lag):
            break
    if echoes is not None:
        lag = np.rint(predicted / patches.spacing_mm).astype(np.int64)
        ramp = wavenumber_per_mm * strain * patches.spacing_mm
        patch_coherences(*echoes, *place, lag, ramp, s.least_overlap, rho, False)
        # Speckle's correlation is nearly the product of what it is along either axis; by chance there may be
        # next to none at the centre.
        centre = np.maximum(rho[:, 1:2, 1:2], LEAST_CORRELATION)
        rho[:, ::2, ::2] = rho[:, ::2, 1:2] * rho[:, 1:2, ::2] / centre
    offset = predicted / patches.spacing_mm - lag
    correlation = _read_at(rho, offset) if s.interpolate else rho[:, 1, 1]
    return PatchMatch(correlation, shift, motion)


def _shift_field(motion: InPlaneMotion, at: FloatArray) -> FloatArray:
    """Where each point of the first frame, `at` mm from the centre, is found in the second, less itself."""
    c, s = np.cos(motion.roll_rad), np.sin(motion.roll_rad)
    moved = at - [motion.x_mm, motion.y_mm]
    return np.asarray(moved @ np.array([[c, -s], [s, c]]) - at)


def _patch_peaks(
    rho: FloatArray, lag: npt.NDArray[np.int64], patches: PatchGrid
) -> tuple[FloatArray, FloatArray]:
    """Sub-sample peak of each patch from parabolas through ln(rho), and how much it is worth."""
    values = _logarithm_or_self(rho)
    offset = np.stack(
        [
            _vertex(values[:, 0, 1], values[:, 1, 1], values[:, 2, 1]),
            _vertex(values[:, 1, 0], values[:, 1, 1], values[:, 1, 2]),
        ],
        axis=1,
    )
    peak = np.clip(rho[:, 1, 1], 0.0, 0.999)
    # Variance of a peak's place goes as (1 - rho^2) / rho^2 (Walker & Trahey 1995).
    weight = np.where(np.isfinite(offset).all(axis=1), peak**2 / (1 - peak**2), 0.0)
    weight = np.where(np.abs(offset).max(axis=1) <= 1.5, weight, 0.0)
    return (lag + offset) * patches.spacing_mm, np.nan_to_num(weight)


def _logarithm_or_self(rho: FloatArray) -> FloatArray:
    """ln(rho) of patches whose lags along both axes are well above zero; else rho itself."""
    return np.where(_sound(rho)[:, None, None], np.log(np.maximum(rho, LEAST_CORRELATION)), rho)


def _sound(rho: FloatArray) -> npt.NDArray[np.bool_]:
    """Which patches' logarithms carry: the corners, which weigh little, may be lower."""
    cross = np.concatenate([rho[:, 1, :], rho[:, ::2, 1]], axis=1)
    return np.asarray(np.nan_to_num(cross, nan=1.0).min(axis=1) > LEAST_CORRELATION)


def _vertex(before: FloatArray, at: FloatArray, after: FloatArray) -> FloatArray:
    curvature = before - 2 * at + after
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(curvature < 0, (before - after) / (2 * curvature), np.nan)


def _fit_motion(
    shift: FloatArray, weight: FloatArray, at: FloatArray, start: InPlaneMotion, predicted: FloatArray
) -> tuple[InPlaneMotion, FloatArray, FloatArray]:
    """In-plane motion by robust least squares, and the smooth (affine) field to read correlations at.

    Last comes the change of axial shift along x and y, which turns the echoes' phase.

    Roll comes from axial shifts alone. Off focus the wavefront is curved, so a turn in the plane moves
    speckle laterally about the focus rather than about the probe, and lateral shifts understate it by a
    fifth and more.
    """
    good = weight > 0
    design = np.column_stack([np.ones(len(at)), at])
    if good.sum() < 6 or np.linalg.matrix_rank(design[good]) < 3:
        return start, predicted, np.zeros(2)
    fits = [_robust_fit(design[good], shift[good, k], weight[good]) for k in range(2)]
    (lateral, lateral_covariance), (axial, axial_covariance) = fits
    covariance = np.zeros((3, 3))
    covariance[0, 0] = lateral_covariance[0, 0]
    covariance[1:, 1:] = axial_covariance[:2, :2]
    # The centre's shift is seen in the second image's axes; its displacement is told in the first's.
    roll = -float(axial[1])
    c, s = np.cos(roll), np.sin(roll)
    x, y = s * axial[0] - c * lateral[0], -s * lateral[0] - c * axial[0]
    motion = InPlaneMotion(float(x), float(y), roll, covariance)
    return motion, np.stack([design @ lateral, design @ axial], axis=1), np.asarray(axial[1:])


def _robust_fit(
    design: FloatArray, data: FloatArray, weight: FloatArray, rounds: int = 5
) -> tuple[FloatArray, FloatArray]:
    """Weighted least squares with Huber weights at 1.5 robust standard deviations.

    Not `core.leastsquares.robust_linear`, whose singular values take twice as long (140 against 75 us for 150
    patches) where every match needs two fits.
    """
    robust = np.ones_like(weight)
    for _ in range(rounds):
        w = weight * robust
        normal = design.T @ (design * w[:, None])
        inverse = np.linalg.inv(normal)
        solution = inverse @ (design.T @ (w * data))
        size = np.abs(data - design @ solution) * np.sqrt(weight)
        scale = MAD_TO_SIGMA * np.partition(size, size.size // 2)[size.size // 2] + 1e-12
        robust = huber_weights(size / scale, 1.5)
    return solution, inverse * scale**2


def _read_at(rho: FloatArray, offset: FloatArray) -> FloatArray:
    """Correlation a fraction of a lag off the centre, by quadratics through ln(rho) in both directions."""
    lateral, axial = (_quadratic_weights(np.clip(offset[:, k], -1.0, 1.0)) for k in range(2))
    sound = _sound(rho)
    log_value = np.einsum("pi,pj,pij->p", lateral, axial, np.log(np.maximum(rho, LEAST_CORRELATION)))
    value = np.einsum("pi,pj,pij->p", lateral, axial, rho)
    return np.asarray(np.where(sound, np.exp(log_value), value))


def _quadratic_weights(t: FloatArray) -> FloatArray:
    """Weights of the values at -1, 0 and 1 in the parabola through them, read at t; shape (p, 3)."""
    return np.stack([t * (t - 1) / 2, 1 - t * t, t * (t + 1) / 2], axis=1)
