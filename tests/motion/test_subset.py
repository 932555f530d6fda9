"""Patches that agree with a sensed orientation."""

import numpy as np
import pytest
from pair_planes import AT

from speckle3d.motion.sensors import consistent_subset


def agreement(distance, sigma, elevation, either_side=True):
    sigma = np.broadcast_to(sigma, distance.shape)
    pair = distance[None], sigma[None], elevation[None], np.array([either_side])
    return consistent_subset(*pair, 1.0)[0]


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("tilt", [-0.006, 0.0, 0.006])
def test_patches_that_under_read_are_left_out(side, tilt):
    """Housden et al. 2008, figure 4: rows at the bottom decorrelate too slowly and tip the free plane."""
    rng, bottom = np.random.default_rng(6), AT[:, 1] > np.quantile(AT[:, 1], 0.65)
    slopes, shares = np.array([0.002, tilt]), []
    for _ in range(25):
        d = np.abs(np.abs(side * 0.35 + AT @ slopes) + 0.015 * rng.normal(size=len(AT)))
        d[bottom] *= 0.6
        shares.append(agreement(d, 0.03, AT @ slopes))
    shares = np.mean(shares, axis=0)
    assert shares[~bottom].mean() > 0.85
    assert shares[bottom].mean() < 0.25


def test_frames_that_cross_are_placed_on_both_sides_unless_the_side_is_wrong_and_held():
    truth = np.array([-0.1, 0.03, 0.01])
    z = truth[0] + AT @ truth[1:]
    assert 0.1 < (z < 0).mean() < 0.9
    assert agreement(np.abs(z), 0.02, AT @ truth[1:]).all()
    assert agreement(np.abs(z), 0.02, -AT @ truth[1:]).all()
    assert not agreement(np.full(len(AT), 0.3), 0.02, AT @ truth[1:], either_side=False).all()
    assert not agreement(np.full(len(AT), np.nan), 0.02, AT @ truth[1:]).any()
