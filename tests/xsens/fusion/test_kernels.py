"""Recordings through the kernels, against the same filter and smoother step by step with filterpy."""

from dataclasses import replace

import fusion_twin as twin
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from xsens.fusion.increments import Samples
from xsens.fusion.smoothing import forward, fresh_filter, smooth, within_steps

from xsens.fusion.settings import FusionSettings

RATE_HZ, SECONDS = 50.0, 40.0


def stretch(seed):
    """A hand's movement with rests, past iron, with a magnet on the sensor and gaps in the field."""
    rng = np.random.default_rng(seed)
    count = int(RATE_HZ * SECONDS)
    time_s = np.arange(count) / RATE_HZ
    moving = (np.sin(0.35 * time_s) > -0.5)[:, None]
    rate = moving * np.stack([1.2 * np.sin(a * time_s + b) for a, b in ((1.7, 0), (1.1, 1), (2.3, 2))], 1)
    steps = Rotation.from_rotvec(rate / RATE_HZ)
    turns = [Rotation.from_rotvec([0.2, -0.1, 2.0])]
    for step in steps[1:]:
        turns.append(turns[-1] * step)
    sensor_from_world = Rotation.concatenate(turns).inv()
    force = sensor_from_world.apply([0.0, 0.0, 9.81]) + 0.4 * moving * rng.standard_normal((count, 3))
    near = np.exp(-((time_s - 25.0) ** 2))[:, None]
    field = np.array([0.02, -0.05, 0.03]) + sensor_from_world.apply(
        near * [0.3, 0.5, 0.2] + [0.45, 0.0, -0.9]
    )
    field[rng.random(count) < 0.1] = np.nan
    gyroscope = rate + [0.01, -0.005, 0.008] + 0.005 * rng.standard_normal((count, 3))
    return Samples(rng.uniform(0.8, 1.2, count) / RATE_HZ, gyroscope, force, field)


def off_deg(found, expected):
    return np.rad2deg(np.linalg.norm(found - expected, axis=(1, 2)).max())


@pytest.mark.parametrize("magnetic", [True, False])
def test_the_filter_takes_the_steps_of_filterpys(magnetic):
    settings, samples = FusionSettings(use_magnetometer=magnetic), stretch(1)
    parts = samples[:1003], samples[1003:]
    theirs, kalman = twin.forward(parts[0], settings)
    theirs_after, _ = twin.forward(parts[1], settings, kalman, 0.7)  # after a pause
    kept = fresh_filter(settings)
    for part, expected, pause_s in zip(parts, (theirs, theirs_after), (0.0, 0.7), strict=True):
        steps = forward(part, settings, kept, pause_s, covariances=True)
        assert off_deg(steps.matrix, np.array([one.matrix for one in expected])) < 1e-7
        np.testing.assert_allclose(steps.bias, [one.bias_rad_s for one in expected], atol=1e-10)
        some = [one.covariance[:9, :9] for one in expected]
        np.testing.assert_allclose(steps.covariance, some, rtol=1e-6, atol=1e-12)
        for name in ("resting", "disturbed", "started"):
            assert (getattr(steps, name) == [getattr(one, name) for one in expected]).all()
    assert steps.resting.any()
    assert steps.disturbed.any() == magnetic


@pytest.mark.parametrize("magnetic", [True, False])
def test_the_smoother_finds_what_filterpys_finds(magnetic):
    settings, samples = FusionSettings(use_magnetometer=magnetic), stretch(2)
    _, expected = twin.smooth(samples, settings)
    steps, found = smooth(samples, settings)
    assert off_deg(found.matrices, expected.matrices) < 1e-7
    np.testing.assert_allclose(found.bias_rad_s, expected.bias_rad_s, atol=1e-10)
    np.testing.assert_allclose(found.sd_rad, expected.sd_rad, rtol=1e-6, atol=1e-10)
    assert (found.disturbed == expected.disturbed).all()
    assert (found.resting == expected.resting).all()
    within = within_steps(steps, found.matrices[:-1], found.bias_rad_s[:-1], found.matrices[1:])
    at_ends = Rotation.from_quat(within[steps.last - 1]).as_matrix()
    assert off_deg(at_ends, found.matrices[1:]) < 1e-6


def test_a_stretch_without_field_is_smoothed_without_north():
    samples = stretch(3)
    samples = replace(samples, field_au=np.full_like(samples.field_au, np.nan))
    _, found = smooth(samples, FusionSettings())
    _, level = smooth(samples, FusionSettings(use_magnetometer=False))
    np.testing.assert_array_equal(found.matrices, level.matrices)
