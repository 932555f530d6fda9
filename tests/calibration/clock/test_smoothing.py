"""Readings between samples: noise alike at all times, motion followed, gaps kept apart."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.clock.smoothing import SmoothReadings
from speckle3d.core.streams import TimedPoses

PERIOD_S = 0.02
TIMES = np.arange(0.0, 8.0, PERIOD_S)


def moving(times):
    """A hand at 0.5 Hz, 20 mm and 17 degrees to either side."""
    swing = np.sin(2 * np.pi * 0.5 * np.asarray(times))
    place = np.outer(20.0 * swing, [1.0, 0.5, 0.0])
    return RigidTransform.from_components(place, Rotation.from_rotvec(np.outer(0.3 * swing, [0.0, 0.6, 0.8])))


def scatter(readings, times):
    """Root mean square error in millimetres and degrees."""
    shift, turn = readings.at(times).as_components()
    exact = moving(times)
    away = shift - exact.translation, np.rad2deg((exact.rotation.inv() * turn).as_rotvec())
    return np.array([np.sqrt(np.mean(one**2)) for one in away])


def test_noise_is_reduced_alike_at_all_times_and_motion_is_followed():
    rng, exact = np.random.default_rng(0), moving(TIMES)
    shift = 0.3 * rng.standard_normal((len(TIMES), 3))
    turn = Rotation.from_rotvec(np.deg2rad(0.2) * rng.standard_normal((len(TIMES), 3)))
    noisy = TimedPoses(
        TIMES, RigidTransform.from_components(exact.translation + shift, exact.rotation * turn)
    )
    on, between = TIMES[20:-20], TIMES[20:-20] + PERIOD_S / 2
    smooth = SmoothReadings(noisy)
    # Straight lines halve the variance midway.
    np.testing.assert_allclose(scatter(noisy, between) / scatter(noisy, on), np.sqrt(0.5), atol=0.06)
    np.testing.assert_allclose(scatter(smooth, between) / scatter(smooth, on), 1.0, atol=0.03)
    # Widths of 45 ms or more have the noise of six samples' mean or less: 0.3 and 0.2 over 2.4.
    assert (scatter(smooth, between) < [0.14, 0.1]).all()
    # A width of one period misses a fourth derivative: 22 mm (0.02 s pi)^4 / 8 = 0.00004 mm.
    assert (scatter(SmoothReadings(TimedPoses(TIMES, exact)), between) < 2e-4).all()
