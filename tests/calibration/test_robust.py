"""Robust linear equations: wrong ones pull little, and groups are weighed as one."""

import numpy as np

from calibration.robust import robust_linear


def test_wrong_equations_pull_little():
    rng = np.random.default_rng(1)
    matrix, truth = rng.normal(size=(200, 2, 3)), np.array([1.0, -2.0, 3.0])
    wanted = matrix @ truth + rng.normal(0, 0.01, (200, 2))
    # One of the two equations is wrong in a tenth of the groups: neither counts.
    wanted[:20, 0] += 500.0
    found, left = robust_linear(matrix, wanted)
    assert np.abs(np.linalg.lstsq(matrix.reshape(-1, 3), wanted.ravel())[0] - truth).max() > 0.5
    # Four solutions are not yet the least absolute residuals.
    np.testing.assert_allclose(found, truth, atol=0.1)
    assert left.shape == wanted.shape
