"""The least-squares problem's derivatives, and the signs of steps."""

import numpy as np
import pytest

from speckle3d.correction.inertial.problem import GLOBALS, ImageSteps, InertialProblem, Prior, Readings
from speckle3d.correction.inertial.signs import settled_signs


@pytest.fixture
def problem():
    rng = np.random.default_rng(5)
    time_s, frame_s = np.arange(0.0, 1.2, 0.01), np.arange(0.1, 1.05, 0.04)
    n, m = frame_s.size - 1, time_s.size
    readings = Readings(
        time_s,
        rng.normal(size=m),
        0.1 * rng.normal(size=(m, 2)),
        rng.normal(size=(m, 3)),
        0.1 * rng.normal(size=(m, 3)),
        rng.normal(size=(m, 3)),
        0.02,
        0.01,
    )
    steps = ImageSteps(frame_s, 0.1 * rng.normal(size=n), np.full(n, 0.01))
    prior = Prior(np.zeros(len(GLOBALS)), np.ones(len(GLOBALS)))
    return InertialProblem(readings, steps, prior, 60.0, 0.05)


def test_jacobian_is_the_residuals_derivative(problem):
    rng = np.random.default_rng(6)
    size, ones = problem._fixed.shape[1], np.ones(problem.steps.steps_mm.size)
    x = 0.1 * rng.normal(size=size)
    x[-len(GLOBALS) :] = [0.1, 0.05, 0.01, 20.0, -90.0, 10.0, 0.1, 0.02, 0.01, 2e-4]
    weights = rng.uniform(0.5, 1.0) * ones
    jacobian = problem._system(x, weights)[0].toarray()
    for column in [*rng.integers(0, size - len(GLOBALS), 12), *range(size - len(GLOBALS), size)]:
        step = np.zeros(size)
        step[column] = 1e-6 * max(1.0, abs(x[column]))
        up, down = (problem._system(x + sign * step, weights)[1] for sign in (1, -1))
        numeric = (up - down) / (2.0 * step[column])
        assert np.allclose(jacobian[:, column], numeric, rtol=1e-5, atol=1e-6 * np.abs(numeric).max())


def test_steps_that_went_the_wrong_way_are_turned():
    time_s = np.arange(0.0, 4.0, 0.04)

    def felt(t):
        return 2.0 * t + 0.5 * np.sin(2.0 * np.pi * 3.0 * t) + 0.3 * t**2

    true = np.diff(2.0 * time_s + 0.5 * np.sin(2.0 * np.pi * 3.0 * (time_s)))
    wrong = np.zeros(true.size, dtype=bool)
    wrong[40:62] = True
    found = settled_signs(felt, time_s, np.where(wrong, -true, true) / 1.1, 0.02)
    clear = np.abs(true) > 0.02
    assert (found.turned == wrong)[clear].all()
    assert found.certainty > 25.0
    assert found.log_scale == pytest.approx(0.1, abs=0.06)
