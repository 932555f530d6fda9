"""The response to tilt: a made law recovered, and what it is worth at the level of patch distances."""

import numpy as np
import pytest
import speckle
from pair_planes import fit_many, problem_of

from speckle3d.core.grid import ImageGrid
from speckle3d.kernels.statistics import correlation_variance
from speckle3d.matching.intensity import two_way_wavenumber
from speckle3d.matching.patches import lay_patches
from speckle3d.motion.phantom import PhantomSamples, fit_curves

DEPTHS_MM = np.arange(5.0, 36.0, 5.0)
CELLS = 60
K_PER_MM = two_way_wavenumber(speckle.RF)


def widths(depth_mm):
    """Curve's standard deviation: faster decorrelation near the face, as off a lens' focus."""
    return np.interp(depth_mm, (5.0, 15.0, 35.0), (0.25, 0.35, 0.45))


def pivots(depth_mm):
    """About a point near the focus at 20 mm, as a probe's curved wavefronts have it."""
    return 0.75 * (np.asarray(depth_mm) - 20.0) - 0.01 * (np.asarray(depth_mm) - 20.0) ** 2


def spreads(depth_mm):
    """A Gaussian beam's: wavenumber times the width squared, where rho = exp(-d^2 / 2 sigma^2)."""
    return K_PER_MM * widths(depth_mm) ** 2


def correlation(depth, offset, tilt):
    """A Gaussian beam: d_eff^2 = (z - pivot theta)^2 + (spread theta)^2."""
    d2 = (offset - pivots(depth) * tilt) ** 2 + (spreads(depth) * tilt) ** 2
    return np.exp(-d2 / (2 * widths(depth) ** 2))


def noisy(rho, rng):
    return rho + np.sqrt(correlation_variance(rho, CELLS, True)) * rng.normal(size=rho.shape)


def phantom_pairs(seed, wander_deg=0.0):
    """Pairs of one phantom sweep of 40 frames, which turn as a hand does as they move."""
    rng = np.random.default_rng(seed)
    z = 0.06 * np.arange(40)
    cycles = rng.uniform(0.3, 2, 3)[:, None] * np.linspace(0, 1, 40) + rng.random((3, 1))
    angle = np.deg2rad(wander_deg) * np.sin(2 * np.pi * cycles).sum(axis=0)
    first, second = np.triu_indices(40, 1)
    near = z[second] - z[first] <= 2.0
    first, second = first[near], second[near]
    tilt = (angle[second] - angle[first])[:, None]
    # Frames turn about the image's middle at 20 mm, as seen from the image's centre.
    offset = (z[second] - z[first])[:, None] + tilt * (DEPTHS_MM - 20.0)
    depth = np.broadcast_to(DEPTHS_MM, offset.shape)
    tilt = np.broadcast_to(tilt, offset.shape)
    rho = noisy(correlation(depth, offset, tilt), rng)
    columns = (np.ravel(c) for c in (depth, offset, tilt, rho))
    return PhantomSamples(*columns, first.size)


@pytest.fixture(scope="module")
def hand_curves():
    """Curves from two sweeps that do not turn and three of hands that do."""
    sweeps = [phantom_pairs(seed, 1.0 * (seed > 1)) for seed in range(5)]
    return fit_curves(speckle.ECHO, sweeps)


def test_the_pivot_of_a_made_law_is_recovered(hand_curves):
    assert hand_curves.tilt is not None
    np.testing.assert_allclose(hand_curves.tilt.pivot_mm, pivots(DEPTHS_MM), atol=1.0)


# ---- what it is worth -------------------------------------------------------------------------------------

GRID = ImageGrid(vectors=127, samples=560, vector_pitch_mm=0.3, sample_spacing_mm=0.06)
PATCHES = lay_patches(GRID)
AT = PATCHES.centre_mm - GRID.centre_mm[:2]


def tilt_sweep(step_mm, seed):
    """Correlations of each patch of a pair that moves a step and tilts by a degree about the centre."""
    tilt = np.deg2rad(1.0)
    depth = PATCHES.centre_mm[:, 1]
    rng = np.random.default_rng(seed)
    return noisy(correlation(depth, step_mm + tilt * AT[:, 1], tilt), rng)


def read_lengths(hand_curves, step_mm):
    """Relative error of length without the response, with it, and with it and a sensed orientation."""
    depth = (5.0, 15.0, 35.0)
    still = speckle.curves(widths(depth), CELLS, depth, key=speckle.ECHO)
    pairs = np.array([tilt_sweep(step_mm, seed) for seed in range(40)], np.float32)
    slopes = np.tile([0.0, np.deg2rad(1.0)], (40, 1))
    plain, full = (problem_of(curves, PATCHES, GRID) for curves in (still, hand_curves))
    read = (fit_many(plain, pairs), fit_many(full, pairs), fit_many(full, pairs, slopes=slopes))
    return np.array([planes.offset_mm.mean() for planes, _ in read]) / step_mm - 1


@pytest.mark.parametrize("step_mm", [0.2, 0.3])
def test_a_degree_of_tilt_per_pair_no_longer_lengthens_the_sweep(hand_curves, step_mm):
    """More than a fifth too long without, less than a twentieth off with the response."""
    without, with_response, with_sensor = read_lengths(hand_curves, step_mm)
    assert without > 0.2
    assert abs(with_sensor) < 0.05
    # Images alone see little of the tilt itself, and the length is better for it all the same.
    assert abs(with_response) < 0.06


def test_without_a_response_the_foci_of_a_fan_lie_on_an_arc_at_the_centres_depth():
    fan = ImageGrid.of_fan(200, 400, 0.1, 60.0, (-0.5, 0.5))
    patches, arc_mm = lay_patches(fan), 60.0 + fan.depth_mm / 2
    levers = problem_of(speckle.curves(0.45, CELLS), patches, fan).levers
    np.testing.assert_allclose(levers.lateral_mm, arc_mm * np.sin(patches.angle_rad), rtol=1e-3)
    np.testing.assert_allclose(levers.lever_mm, arc_mm * (np.cos(patches.angle_rad) - 1), atol=0.05)
