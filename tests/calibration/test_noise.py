"""Least squares with errors that wander: against dense algebra, and whether claimed errors are true."""

import numpy as np
import pytest

from calibration.noise import fit_wandering


def linear_problem(rng, size, frames=60, several=2, spacing_s=0.2, constant_s=4.0):
    """A linear problem whose answer is zero: Jacobian, residuals, effects, first rows of frames, times."""
    time_s = spacing_s * np.cumsum(rng.uniform(0.5, 1.5, frames))
    turning = np.cumsum(0.1 * rng.standard_normal((frames * several, 3)), axis=0)
    jacobian = np.column_stack([np.cos(turning[:, 0]), np.sin(turning[:, 1]), np.ones(len(turning))])
    effects = rng.standard_normal((frames * several, 2))
    moving = rng.standard_normal((frames, 2))
    for i, a in enumerate(np.exp(-np.diff(time_s) / constant_s)):
        moving[i + 1] = a * moving[i] + np.sqrt(1.0 - a * a) * moving[i + 1]
    residuals = size * np.sum(effects * np.repeat(moving, several, axis=0), axis=1)
    residuals += rng.standard_normal(len(residuals))
    return jacobian, residuals, effects, several * np.arange(frames + 1), time_s


def test_one_size_and_time_give_what_dense_algebra_gives():
    jacobian, residuals, effects, starts, time_s = linear_problem(np.random.default_rng(1), 1.0)
    unit = 1.0 / np.mean(np.sum(effects**2, axis=1))
    grid = np.array([[2.0, 0.5, 0.8, 1.0, unit, unit]])
    noise, _ = fit_wandering(jacobian, residuals, effects, starts, time_s, grid)
    group = np.repeat(np.arange(60), 2)
    lag = np.abs(time_s[group][:, None] - time_s[group])
    correlation = 4.0 * np.exp(-lag / 0.8) + 0.25 * (group[:, None] == group)
    whole = np.eye(120) + unit * (effects @ effects.T) * correlation
    weights = jacobian.T @ np.linalg.inv(whole)
    bread = np.linalg.inv(weights @ jacobian)
    step = -bread @ weights @ residuals
    residual = residuals + jacobian @ step
    variance = residual @ np.linalg.solve(whole, residual) / 117
    np.testing.assert_allclose(noise.step, step, rtol=1e-9)
    np.testing.assert_allclose(noise.covariance, variance * bread * 117 / 115, rtol=1e-9)
    assert noise.white == pytest.approx(np.sqrt(variance))
