"""The sign of motion from turns that images and an orientation sensor saw: told, or left open."""

import numpy as np
import pytest

from speckle3d.motion.sensors import same_turns


def slow(rng, frames, duration_s, highest_hz):
    """Turns of a hand: a dozen sinusoids up to a frequency, of unit rms, for tilt and yaw."""
    t = np.linspace(0, duration_s, frames)
    frequency, phase = rng.uniform(0, highest_hz, (2, 12)), rng.uniform(0, 2 * np.pi, (2, 12))
    wave = np.sin(2 * np.pi * t[:, None, None] * frequency + phase)
    return wave.sum(axis=2) / np.sqrt(6)


def signs(count, frames, duration_s, highest_hz, common, drift_size):
    """Signs by records that share turns of size `common`, the second with a drift of its own besides."""
    votes = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        hand, drift, noise = (slow(rng, frames, duration_s, highest_hz) for _ in range(3))
        votes.append(same_turns(hand + 0.1 * noise, common * hand + drift_size * drift))
    return votes


@pytest.mark.parametrize(("frames", "duration_s", "hz"), [(64, 2.6, 1.0), (160, 6.4, 0.3), (300, 12.0, 0.3)])
def test_records_with_nothing_in_common_tell_nothing(frames, duration_s, hz):
    votes = signs(300, frames, duration_s, hz, 0.0, 1.0)
    # 1.2 % by normal chance at 2.5 deviations, twice that for variances that are estimated, and counting.
    assert votes.count(None) >= 288


@pytest.mark.parametrize(("frames", "duration_s", "hz"), [(64, 2.6, 0.3), (160, 6.4, 0.3), (160, 6.4, 1.0)])
def test_the_same_motion_is_recognised(frames, duration_s, hz):
    votes = signs(200, frames, duration_s, hz, 1.0, 0.2)
    assert votes.count(-1) == 0
    assert votes.count(1) >= 160
