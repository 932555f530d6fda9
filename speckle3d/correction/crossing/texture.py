"""What of the images two sweeps have in common: local contrast, at several blurs."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from speckle3d.core.arrays import Float32Array, FloatArray

_TREND_MM, _LOCAL_MM = 5.0, 4.0
"""Standard deviations: of the trend along the beam (gain, attenuation, shadows), and of local mean and
contrast. Without them shadows, which follow the probe, move the best match away from the truth."""
_LAYER_MM = (4.0, 4.0, 0.7)
"""Standard deviations along the sweep, across and along the beam of the mean that takes layers away: parallel
to the skin they look alike at any turn and place, and drown what tells places apart."""
_LEAST_DB = 0.5
"""Contrast below which there is nothing but noise to divide by, dB."""
_REACH = 2.5
"""Standard deviations to which Gaussians are cut."""


def prefiltered(volume: Float32Array, spacing_mm: FloatArray) -> Float32Array:
    """Local contrast of images in dB, shape (k, u, v); NaN stays."""
    there = np.isfinite(volume)
    weight = there.astype(np.float32)
    left = np.where(there, volume, np.float32(0.0))
    trend = _TREND_MM / spacing_mm[2]
    with np.errstate(invalid="ignore", divide="ignore"):
        level = gaussian_filter1d(left, trend, axis=2, truncate=_REACH)
        level /= gaussian_filter1d(weight, trend, axis=2, truncate=_REACH)
        left = np.where(there, left - level, np.float32(0.0))
        share = blurred(weight, _LOCAL_MM, spacing_mm)
        left = np.where(there, left - blurred(left, _LOCAL_MM, spacing_mm) / share, np.float32(0.0))
        layers = blurred(left, np.array(_LAYER_MM), spacing_mm)
        layers /= blurred(weight, np.array(_LAYER_MM), spacing_mm)
        left = np.where(there, left - layers, np.float32(0.0))
        contrast = np.sqrt(np.maximum(blurred(left**2, _LOCAL_MM, spacing_mm) / share, 0.0))
        return np.asarray(np.where(there, left / np.maximum(contrast, _LEAST_DB), np.nan), dtype=np.float32)


def blurred(volume: Float32Array, sigma_mm: float | FloatArray, spacing_mm: FloatArray) -> Float32Array:
    """Gaussian blur of a volume without NaN."""
    return np.asarray(gaussian_filter(volume, sigma_mm / spacing_mm, truncate=_REACH, mode="constant"))


def at_blur(texture: Float32Array, sigma_mm: float, spacing_mm: FloatArray) -> Float32Array:
    """Blurred texture; NaN where there was none."""
    there = np.isfinite(texture)
    full = blurred(np.where(there, texture, np.float32(0.0)), sigma_mm, spacing_mm)
    share = blurred(there.astype(np.float32), sigma_mm, spacing_mm)
    return np.asarray(np.where(there, full / np.maximum(share, 1e-3), np.nan), dtype=np.float32)
