"""Readings between samples: noise alike at all times, motion followed, gaps kept apart."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.clock.smoothing import smooth
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.streams import TimedPoses, TimedRotations

PERIOD_S = 0.02
TIMES = np.arange(0.0, 8.0, PERIOD_S)


def moving(times, amplitude_mm=20.0):
    """A hand at 0.5 Hz, 20 mm and 17 degrees to either side."""
    swing = np.sin(2 * np.pi * 0.5 * np.asarray(times))
    place = np.outer(amplitude_mm * swing, [1.0, 0.5, 0.0])
    return RigidTransform.from_components(place, Rotation.from_rotvec(np.outer(0.3 * swing, [0.0, 0.6, 0.8])))


def shaken(rng, noise_mm=0.3, noise_deg=0.2, times=TIMES):
    exact = moving(times)
    shift = noise_mm * rng.standard_normal((len(times), 3))
    turn = Rotation.from_rotvec(np.deg2rad(noise_deg) * rng.standard_normal((len(times), 3)))
    poses = RigidTransform.from_components(exact.translation + shift, exact.rotation * turn)
    return TimedPoses(times, poses)


def errors(readings, times):
    """Millimetres and degrees from the truth."""
    found, exact = readings.at(times), moving(times)
    turned = np.rad2deg((exact.rotation.inv() * found.rotation).as_rotvec())
    return found.translation - exact.translation, turned


def test_noise_is_as_large_midway_between_samples_as_at_them():
    def scatter(readings, at):
        return np.array([np.sqrt(np.mean(each**2)) for each in errors(readings, at)])

    seen = [shaken(np.random.default_rng(seed)) for seed in range(2)]
    on, between = TIMES[20:-20], TIMES[20:-20] + PERIOD_S / 2
    straight = np.mean([scatter(r, between) / scatter(r, on) for r in seen], axis=0)
    curved = np.mean([scatter(smooth(r), between) / scatter(smooth(r), on) for r in seen], axis=0)
    # Straight lines halve the variance; of parabolas as wide as is chosen here it is the same to 1 %.
    np.testing.assert_allclose(straight, np.sqrt(0.5), atol=0.04)
    np.testing.assert_allclose(curved, 1.0, atol=0.02)


def test_noise_is_reduced_and_motion_is_not():
    noisy = shaken(np.random.default_rng(0))
    inside = TIMES[20:-20] + 0.3 * PERIOD_S
    shift, turn = errors(smooth(noisy), inside)
    # Widths of 45 ms or more have the noise of six samples' mean or less: 0.3 and 0.2 over 2.4.
    assert np.std(shift) < 0.14
    assert np.std(turn) < 0.1
    exact = smooth(TimedPoses(TIMES, moving(TIMES)))
    # A width of one period misses a fourth derivative: 22 mm (0.02 s pi)^4 / 8 = 0.00004 mm.
    assert max(np.abs(each).max() for each in errors(exact, inside)) < 2e-4


def test_samples_beyond_a_gap_do_not_count_and_gaps_are_refused():
    step = np.where(TIMES < 4.0, 0.0, 100.0)
    there = (TIMES < 4.0) | (TIMES > 4.3)
    place = np.outer(step, [1.0, 0.0, 0.0])[there]
    readings = smooth(TimedPoses(TIMES[there], RigidTransform.from_translation(place)))
    np.testing.assert_allclose(readings.at([3.9, 3.98]).translation[:, 0], 0.0, atol=1e-9)
    np.testing.assert_allclose(readings.at([4.33, 4.4]).translation[:, 0], 100.0, atol=1e-9)
    with pytest.raises(InsufficientDataError, match="cover"):
        readings.at([4.1])


def test_turns_alone_and_few_samples_are_read_too():
    turns = moving(TIMES).rotation
    found = smooth(TimedRotations(TIMES, turns)).at(TIMES[5:50] + 0.004)
    away = (moving(TIMES[5:50] + 0.004).rotation.inv() * found).magnitude()
    assert away.max() < 1e-5
    few = smooth(TimedRotations(TIMES[:3], turns[:3]))
    assert (turns[1].inv() * few.at([0.02])).magnitude().max() < 1e-9
