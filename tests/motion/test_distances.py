"""Distances of single patches: the inverse of the curves, with deviations that hold."""

import numpy as np
import pytest
import speckle
from pair_planes import problem_of

from speckle3d.kernels.plane_misfit import EchoModels
from speckle3d.matching.patches import lay_patches
from speckle3d.motion.planes import patch_distances

PATCHES = lay_patches(speckle.GRID)
SIGMA_MM, CELLS = 0.45, 45.0


def problem(**curves):
    phantom = speckle.curves(sigma_mm=SIGMA_MM, cells=CELLS, key=speckle.ECHO, **curves)
    return problem_of(phantom, PATCHES, speckle.GRID)


def read(problem, rho, share=0.0, gain=1.0):
    rho = np.full((1, len(PATCHES)), rho) if np.ndim(rho) == 0 else np.atleast_2d(rho)
    models = EchoModels(*(np.full((1, len(PATCHES)), value) for value in (share, gain)))
    return patch_distances(problem, rho, models)


@pytest.mark.parametrize(("share", "gain"), [(0.0, 1.0), (0.5, 0.8)])
def test_distance_is_the_inverse_of_the_echo_model(share, gain):
    for d in (0.02, 0.1, 0.4, 0.9):
        g = np.exp(-(d**2) / (4 * SIGMA_MM**2))
        distance, sigma = read(problem(), gain * (share + (1 - share) * g) ** 2, share, gain)
        np.testing.assert_allclose(distance, d, atol=2e-3)
        assert (sigma > 0).all()


def test_without_correlation_below_what_stays_or_beyond_the_curves_there_is_no_distance():
    for full, rho, share in ((problem(), np.nan, 0.0), (problem(), 0.01, 0.0), (problem(), 0.24, 0.5)):
        assert np.isnan(read(full, rho, share)).all()
    short = problem(largest_mm=SIGMA_MM)
    assert np.isnan(read(short, speckle.gaussian_correlation(1.1 * SIGMA_MM, SIGMA_MM))[0]).all()
    assert (short.typical_correlation(np.array([0.9])) == 0.0).all()
    assert (problem(largest_mm=2.0).typical_correlation(np.array([30.0])) > 0.0).all()


@pytest.mark.parametrize("u", [1 / 3, 2 / 3, 1.0, 1.5])
def test_an_echos_deviation_is_the_cramer_rao_bound(u):
    d, r = u * SIGMA_MM, np.exp(-(u**2) / 4)
    bound = (1 - r**2) / (np.sqrt(2 * CELLS) * r * d / (2 * SIGMA_MM**2))
    _, sigma = read(problem(), r**2)
    # Above it by 1 / (4 N rho) at the last and by what interpolation leaves at the first.
    assert (np.abs(sigma / bound - 1.02) < 0.05).all()
