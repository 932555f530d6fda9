"""Sampling variances against draws of speckle whose cells are counted."""

from functools import cache

import numpy as np
import pytest
import speckle
from patch_kernels import patch_coherences, patch_correlations

from speckle3d.kernels.statistics import correlation_variance
from speckle3d.matching.patches import lay_patches

pytestmark = pytest.mark.slow
PATCHES = lay_patches(speckle.GRID)


def cells(power):
    """Area of a patch over the integral of |rho_c|^power of the field, both axes, within the patch."""
    total = 1.0
    for count, step, sigma in zip(
        PATCHES.size, PATCHES.spacing_mm, (speckle.LATERAL_MM, speckle.AXIAL_MM), strict=True
    ):
        lag = np.arange(1 - count, count)
        # |rho_c|^2 is exp(-d^2 / 2 sigma^2).
        like = speckle.gaussian_correlation(lag * step, sigma) ** (power / 2)
        total *= count / (like * (1 - np.abs(lag) / count)).sum()
    return total


@cache
def fields():
    return [speckle.Speckle(np.random.default_rng(seed)).image() for seed in range(25)]


@cache
def sample_correlations(rho):
    """Correlations of echo and of intensity, patch by patch, of frames that have `rho` in common."""
    correlations = np.empty((2, len(fields()) - 1, len(PATCHES)))
    still, out = np.zeros((len(PATCHES), 2), np.int64), np.empty((len(PATCHES), 5))
    for k, (fixed, independent) in enumerate(zip(fields()[:-1], fields()[1:], strict=True)):
        moving = speckle.mix(fixed, independent, rho)
        echoes = (np.stack([z.real, z.imag]).astype(np.float32) for z in (fixed, moving))
        place = PATCHES.first, PATCHES.size, still
        patch_coherences(*echoes, *place, np.zeros(2), 0.6, out)
        correlations[0, k] = out[:, 2]
        patch_correlations(speckle.intensity(fixed), speckle.intensity(moving), *place, 0.6, out)
        correlations[1, k] = out[:, 2]
    return correlations


@pytest.mark.parametrize("rho", [0.0, 0.4, 0.9])
def test_variance_of_the_echos_correlation_over_speckle(rho):
    """With cells from the field's own autocorrelation, nothing fitted: 10 % of the deviation."""
    sigma = np.sqrt(correlation_variance(rho, cells(2), True))
    assert sample_correlations(rho)[0].std() == pytest.approx(sigma, rel=0.1)


def test_variance_of_intensitys_correlation_where_speckle_is_gone():
    """There nothing but the cells counts, and intensity, the echo's square, has twice as many."""
    variance = correlation_variance(0.0, cells(4), False)
    assert sample_correlations(0.0)[1].var() == pytest.approx(variance, rel=0.15)
