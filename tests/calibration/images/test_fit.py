"""How fast the similarity falls about an answer, by its values and not by its slopes."""

import dataclasses

import numpy as np
import pytest
from crossing_scenes import crossing_sweeps, displaced

from calibration.images.fit import APART_MM, LEVERS_MM, SETTLED, curvature, refine, settle
from calibration.images.similarity import Estimate, Level, prepare

FREE = tuple(range(6))


@pytest.fixture(scope="module")
def refined():
    """Few images and little blur: speckle is strong."""
    first, second, truth = crossing_sweeps(1, frames=30)
    crossing = prepare(first, second)
    start = Estimate(displaced(truth, np.random.default_rng(2), 0.5, 0.5), np.ones(2))
    return refine(crossing.level(Level(0.7, images=10), truth), start, FREE, max_steps=6)


@pytest.fixture(scope="module")
def settled(refined):
    return settle(refined)[0]


@pytest.mark.slow
def test_the_similarity_falls_as_its_curvature_says(refined, settled):
    held = dataclasses.replace(settled, weight=refined.weight)
    bend = curvature(held)
    for parameter in FREE:
        step = np.zeros(8)
        step[parameter] = APART_MM / LEVERS_MM[parameter]
        here, left, right = (alike_at(held, sign * step) for sign in (0.0, -1.0, 1.0))
        fall = np.nansum(held.weight * (here - 0.5 * (left + right)))
        told = 0.5 * bend[parameter, parameter] * (APART_MM / LEVERS_MM[parameter]) ** 2
        # Half the squared step, if the curvature were the same all the way; it is less farther out.
        assert told == pytest.approx(fall, rel=0.3)


def alike_at(refined, step):
    moved = refined.estimate.stepped(step, refined.pivot_mm)
    return refined.comparison.at(moved).alike


def test_gauss_newtons_matrix_is_stiffer(refined):
    normal, _ = refined.system
    part = np.linalg.eigvals(np.linalg.solve(normal, curvature(refined))).real
    # Speckle's slopes are in the one and not in the other: 0.1 to 0.7 in nine scenes.
    assert (part > 0).all()
    assert (part < 0.9).all()


def test_what_is_settled_cannot_be_bettered(refined, settled):
    assert settled.converged
    base = np.diag(LEVERS_MM[:6])
    left = np.linalg.solve(curvature(settled), settled.system[1])
    # Ten times where steps stop: the curvature here is not quite that of where the steps began.
    assert np.abs(base @ left).max() < 10.0 * SETTLED
    # What is raised is a weighted mean; the plain one may lose a little by it.
    assert settled.similarity.mean >= refined.similarity.mean - 1e-3
