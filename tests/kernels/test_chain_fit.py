"""All steps of a chain's least squares in one kernel, against SciPy's MINPACK and NumPy."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from calibration.chain import PROBE
from calibration.equations import BareChain, Equations, columns_of
from speckle3d.core.errors import InvalidInputError

PLANE = columns_of((*PROBE, "z_c", "beta_c", "gamma_c"))
WIRES = columns_of((*PROBE, "x_c", "y_c", "z_c", "alpha_c", "beta_c", "gamma_c"))
UNKNOWN = np.array([1.0, 1.0, 0.0, 0.0])
CLOSE = np.array([0.11, 0.12, *np.full(12, 0.03)])


def problem(seed, columns, points=70, several=1, noise=0.05):
    """Equations that parameters near those of a start solve, but for noise; the start; parameters."""
    rng = np.random.default_rng(seed)
    turns = np.linalg.qr(rng.standard_normal((points, 3, 3)))[0]
    turns *= np.linalg.det(turns)[:, None, None]
    rows = np.tile([0.0, 0.0, 1.0], (points, 1, 1)) if several == 1 else rng.standard_normal((points, 2, 3))
    pixels, shifts = rng.uniform(0.0, 300.0, (points, 2)), rng.uniform(-40.0, 40.0, (points, 3))
    chain = BareChain(CLOSE[:2] / 1.1, np.eye(4), np.eye(4)).moved_to(chain_at(rng))
    truth = np.append(chain.pixel_mm * [1.1, 0.95], np.zeros(12))
    truth[columns[2:]] += 0.05 * rng.standard_normal(len(columns) - 2)
    equations = Equations(pixels, turns, shifts, rows, np.zeros((points, several)))
    left = equations.near(chain).derivatives(truth, columns)[0].reshape(points, several)
    offsets = np.ascontiguousarray(left + noise * rng.standard_normal(left.shape))
    return Equations(pixels, turns, shifts, rows, offsets), chain, truth


def chain_at(rng):
    return np.append(CLOSE[:2], rng.uniform(-0.5, 0.5, 12))


def by_scipy(equations, chain, columns, weights, known):
    near, origin = equations.near(chain), chain.on_image

    def residuals(x):
        full = origin.copy()
        full[columns] = x
        values = near.derivatives(full, columns, weights)[0]
        if known[2]:
            values = values / (full[1] / origin[1] if known[3] else 1.0)
            values = np.append(values, known[2] * (full[:2] / known[:2] - 1.0))
        return values

    return least_squares(residuals, origin[columns], x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12).x


@pytest.mark.parametrize("in_rows", [None, 0.0, 1.0])
@pytest.mark.parametrize(("columns", "several"), [(PLANE, 1), (WIRES, 2)])
def test_ends_where_scipy_ends(columns, several, in_rows):
    equations, chain, _ = problem(several, columns, several=several)
    known = UNKNOWN if in_rows is None else np.array([*chain.pixel_mm, 0.3, in_rows])
    weights = np.random.default_rng(3).uniform(0.2, 2.0, equations.offsets.shape)
    found, _, converged = equations.least_squares(chain, columns, weights, known, 1e-12)
    assert converged
    np.testing.assert_allclose(found[columns], by_scipy(equations, chain, columns, weights, known), atol=2e-7)


def test_exact_equations_are_solved_and_held_parameters_stay():
    equations, chain, truth = problem(5, PLANE, noise=0.0)
    found, _, converged = equations.least_squares(chain, PLANE, None, UNKNOWN, 1e-12)
    assert converged
    np.testing.assert_allclose(found, truth, atol=1e-9)
    held = columns_of(("z_c", "beta_c"))
    stayed = np.delete(equations.least_squares(chain, held, None, UNKNOWN, 1e-9)[0], held)
    np.testing.assert_array_equal(stayed, np.delete(chain.on_image, held))


def test_a_direction_that_nothing_determines_is_left_alone():
    # Heights above a plane do not change as it is displaced along itself.
    equations, chain, truth = problem(6, PLANE, noise=0.0)
    both = columns_of((*PROBE, "x_c", "z_c", "beta_c", "gamma_c"))
    found, _, _ = equations.least_squares(chain, both, None, UNKNOWN, 1e-12)
    np.testing.assert_allclose(equations.near(chain).derivatives(found, both)[0], 0.0, atol=1e-7)
    assert abs(found[8]) < 1e-6
    np.testing.assert_allclose(found[PLANE], truth[PLANE], atol=1e-7)


def test_too_few_residuals_or_one_that_is_not_finite_are_refused():
    equations, chain, _ = problem(7, PLANE, points=10)
    with pytest.raises(InvalidInputError, match="11 residuals, got 10"):
        equations.least_squares(chain, PLANE, None, UNKNOWN, 1e-9)
    equations, chain, _ = problem(7, PLANE)
    equations.offsets[3] = np.nan
    with pytest.raises(InvalidInputError, match="finite"):
        equations.least_squares(chain, PLANE, None, UNKNOWN, 1e-9)
