"""Least squares with errors that wander: against dense algebra, and whether claimed errors are true."""

import numpy as np
import pytest

from calibration import wander
from calibration.wander import SensorError, attributed, wandering_fit
from speckle3d.core.errors import MismatchError


def drawn(rng, size, frames=60, several=2, spacing_s=0.2, constant_s=4.0):
    """A linear problem whose answer is zero: its Jacobian, residuals, frames, times, and sensor."""
    time_s = spacing_s * np.cumsum(rng.uniform(0.5, 1.5, frames))
    turning = np.cumsum(0.1 * rng.standard_normal((frames * several, 3)), axis=0)
    jacobian = np.column_stack([np.cos(turning[:, 0]), np.sin(turning[:, 1]), np.ones(len(turning))])
    effects = rng.standard_normal((frames * several, 2))
    kept = np.exp(-np.diff(time_s) / constant_s)
    moving = np.empty((frames, 2))
    moving[0] = rng.standard_normal(2)
    for i, a in enumerate(kept):
        moving[i + 1] = a * moving[i] + np.sqrt(1.0 - a * a) * rng.standard_normal(2)
    residuals = size * np.sum(effects * np.repeat(moving, several, axis=0), axis=1)
    residuals += rng.standard_normal(len(residuals))
    group = np.repeat(np.arange(frames), several)
    return jacobian, residuals, group, np.repeat(time_s, several), SensorError(effects, (np.ones(2),))


def test_one_size_and_time_give_what_dense_algebra_gives(monkeypatch):
    jacobian, residuals, group, time_s, error = drawn(np.random.default_rng(1), 1.0)
    monkeypatch.setattr(wander, "WANDER", (2.0,))
    monkeypatch.setattr(wander, "_TIMES", 1)
    fit = wandering_fit(jacobian, residuals, group, time_s, error, jitter=(0.5,))
    spacing = np.median(np.diff(time_s[::2]))
    unit = 1.0 / np.mean(np.sum(error.effects**2, axis=1))
    together = error.effects @ error.effects.T * unit
    apart_s = np.abs(time_s[:, None] - time_s)
    whole = np.eye(len(group)) + together * (
        4.0 * np.exp(-apart_s / (4.0 * spacing)) + 0.25 * (group[:, None] == group)
    )
    weighed = jacobian.T @ np.linalg.inv(whole)
    bread = np.linalg.inv(weighed @ jacobian)
    step = -bread @ weighed @ residuals
    left = residuals + jacobian @ step
    variance = left @ np.linalg.solve(whole, left) / (len(left) - 3)
    np.testing.assert_allclose(fit.step, step, rtol=1e-9)
    np.testing.assert_allclose(fit.covariance, variance * bread, rtol=1e-9)
    assert fit.white == pytest.approx(np.sqrt(variance))
    assert fit.wander == pytest.approx(2.0 * fit.white)


def test_what_is_known_before_counts_as_one_more_measurement(monkeypatch):
    jacobian, residuals, group, time_s, error = drawn(np.random.default_rng(2), 0.0)
    monkeypatch.setattr(wander, "WANDER", (0.0,))
    prior, excess = np.diag([0.0, 50.0, 0.0]), np.array([0.0, 0.3, 0.0])
    fit = wandering_fit(jacobian, residuals, group, time_s, error, (0.0,), prior, excess)
    rows = np.vstack([jacobian / fit.white, [0.0, np.sqrt(50.0), 0.0]])
    wanted = -np.append(residuals / fit.white, np.sqrt(50.0) * 0.3)
    np.testing.assert_allclose(fit.step, np.linalg.lstsq(rows, wanted, rcond=None)[0], rtol=1e-6)
    np.testing.assert_allclose(fit.covariance, np.linalg.inv(rows.T @ rows), rtol=1e-6)


def test_errors_of_sensor_and_image_make_the_residuals():
    jacobian, residuals, group, time_s, error = drawn(np.random.default_rng(3), 2.0)
    fit = wandering_fit(jacobian, residuals, group, time_s, error)
    sensor, image = attributed(residuals, group, error, fit)
    np.testing.assert_allclose(np.sum(error.effects * sensor, axis=1) + image, residuals, atol=1e-9)
    assert (sensor[::2] == sensor[1::2]).all()
    # Most of them is the sensor's, whose effect is 2.8 where the white noise is 1.
    assert image.std() < 0.6 * residuals.std()


def test_exact_data_are_no_accident():
    jacobian, _, group, time_s, error = drawn(np.random.default_rng(4), 0.0)
    fit = wandering_fit(jacobian, np.zeros(len(group)), group, time_s, error)
    assert np.isfinite(fit.covariance).all()
    assert not fit.step.any()


def test_arrays_of_other_lengths_are_refused():
    jacobian, residuals, group, time_s, error = drawn(np.random.default_rng(5), 0.0)
    with pytest.raises(MismatchError, match="119, 120"):
        wandering_fit(jacobian, residuals[:-1], group, time_s, error)


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.0, 0.5, 2.0])
def test_errors_lie_within_those_claimed(size):
    scores = []
    for seed in range(150):
        problem = drawn(np.random.default_rng([seed, 11]), size)
        fit = wandering_fit(*problem)
        scores.append(fit.step / np.sqrt(np.diag(fit.covariance)))
    # 450 figures, three of each draw alike: their coverage is known to 4 and 2 %.
    within = np.abs(scores)
    assert 0.60 <= np.mean(within < 1.0) <= 0.80
    assert 0.90 <= np.mean(within < 1.96) <= 0.99
