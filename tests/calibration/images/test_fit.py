"""How fast the similarity falls about an answer, by its values and not by its slopes."""

import numpy as np
import pytest
from crossing_scenes import crossing_sweeps, displaced

from calibration.images.angulation import angulation
from calibration.images.errors import curvature_of
from calibration.images.fit import LEVERS_MM, SETTLED, refine, settle
from calibration.images.similarity import Estimate, Level, prepare

FREE = tuple(range(6))


@pytest.mark.slow
def test_what_is_settled_cannot_be_bettered_and_gauss_newtons_matrix_is_stiffer():
    # Few images and little blur: speckle is strong.
    first, second, truth = crossing_sweeps(1, frames=30)
    crossing = prepare(first, second)
    start = Estimate(displaced(truth, np.random.default_rng(2), 0.5, 0.5), np.ones(2))
    refined = refine(crossing.level(Level(0.7, images=10), truth), start, FREE, max_steps=6)
    poses = [stack.world_from_sensor for stack in crossing.used]
    angles = angulation(*poses, truth, crossing.used[0].corners_mm)
    _, curvature = curvature_of(refined, angles, crossing.unit)
    # Speckle's slopes are in the one and not in the other.
    part = np.linalg.eigvals(np.linalg.solve(refined.system[0], curvature)).real
    assert (part > 0).all()
    assert (part < 0.9).all()
    settled = settle(refined, curvature)
    assert settled.converged
    left = np.linalg.solve(curvature, settled.system[1])
    assert np.abs(LEVERS_MM[:6] * left).max() < 10.0 * SETTLED
    # What is raised is a weighted mean; the plain one may lose a little by it.
    assert settled.similarity.mean >= refined.similarity.mean - 1e-3
