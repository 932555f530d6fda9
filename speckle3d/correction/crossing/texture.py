"""Local contrast of a sweep's images: what two sweeps have in common."""

import numpy as np
from scipy.ndimage import gaussian_filter

from speckle3d.core.arrays import Float32Array, FloatArray

_TRENDS_MM = ((0.0, 0.0, 5.0), (4.0, 4.0, 4.0), (4.0, 4.0, 0.7))
"""Standard deviations along the sweep, across and along the beam of the means that are subtracted. First
gain, attenuation and shadows, which follow the probe and move the best match away from the truth; then the
local mean, over whose neighbourhood the contrast is made one; last layers, which parallel to the skin
look alike at any turn and place."""
_LEAST_DB = 0.5
"""Contrast below which there is nothing but noise to divide by, dB."""


def local_contrast(volume: Float32Array, spacing_mm: FloatArray) -> Float32Array:
    """Images in dB without trends, over their local standard deviation, shape (k, u, v); NaN stays."""
    for sigma_mm in _TRENDS_MM:
        volume = volume - gaussian_mean(volume, sigma_mm, spacing_mm)
    contrast = np.sqrt(gaussian_mean(volume**2, _TRENDS_MM[1], spacing_mm))
    return np.asarray(volume / np.maximum(contrast, _LEAST_DB), dtype=np.float32)


def gaussian_mean(
    volume: Float32Array, sigma_mm: float | tuple[float, float, float], spacing_mm: FloatArray
) -> Float32Array:
    """Gaussian mean over the neighbours that are not NaN; NaN where there was none."""
    valid, sigma = np.isfinite(volume), np.divide(sigma_mm, spacing_mm)
    total, share = (
        gaussian_filter(values, sigma, mode="constant")
        for values in (np.where(valid, volume, np.float32(0.0)), valid.astype(np.float32))
    )
    return np.asarray(np.where(valid, total / np.maximum(share, 1e-3), np.nan), dtype=np.float32)
