"""The delay from images of a motion forward and back: found on simulated tissue, else refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from calibration.clock.images import delay_from_images
from calibration.points import Recording
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.streams import TimedPoses
from speckle3d.io.load import load_sweep
from speckle3d.study.images import GreyImages

RATE_HZ = 50.0


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def recording(back):
    """Tissue passed forward and back; the simulated images, not the sensor."""
    sweep = load_sweep(back)
    grey = GreyImages(sweep, 60.0, clipped=False)
    return sweep, np.stack([grey[i] for i in range(len(sweep))]), grey.grid


def recording_with(recording, offset_s, jitter_mm=0.0, seed=0):
    """The images with readings of their true poses on another clock; frames at the ends have none."""
    sweep, images, grid = recording
    times = np.arange(sweep.frame_time_s[0], sweep.frame_time_s[-1], 1.0 / RATE_HZ)
    true = TimedPoses(sweep.frame_time_s, sweep.truth).at(times)
    jitter = jitter_mm * np.random.default_rng(seed).standard_normal((len(times), 3))
    poses = RigidTransform.from_translation(jitter) * true
    return Recording(images, grid, sweep.frame_time_s, TimedPoses(times - offset_s, poses))


# Two milliseconds is the target; the poses here are interpolated between frames 40 ms apart.
@pytest.mark.parametrize("offset_s", [0.065, -0.03])
def test_delay_of_simulated_tissue(recording, offset_s):
    delay = delay_from_images(recording_with(recording, offset_s), RigidTransform.identity(), 0.15, 0.0)
    assert delay.seconds == pytest.approx(offset_s, abs=0.002)
    assert delay.standard_error_s < 0.002


def test_the_standard_error_knows_the_trackers_jitter(recording):
    exact = delay_from_images(recording_with(recording, 0.02), RigidTransform.identity(), 0.1, 0.0)
    noisy = [
        delay_from_images(recording_with(recording, 0.02, 0.2, seed), RigidTransform.identity(), 0.1, 0.0)
        for seed in (1, 2, 3)
    ]
    # 0.2 mm in 100 readings at 10 mm/s: 0.2 * 2 / 10 / 20 = 2 ms, less what counts for the bootstrap too.
    for delay in noisy:
        assert delay.standard_error_s > exact.standard_error_s
        assert 0.0012 < delay.standard_error_s < 0.006
        assert abs(delay.seconds - 0.02) < 3.0 * delay.standard_error_s


def noise(images):
    return np.random.default_rng(0).standard_normal(images.shape)


@pytest.mark.parametrize(
    ("change", "offset_s", "search_s"),
    [
        (np.asarray, 0.2, 0.08),  # outside the range
        (noise, 0.0, 0.4),
    ],
)
def test_no_delay_outside_the_range_or_of_noise(recording, change, offset_s, search_s):
    whole = recording_with(recording, offset_s)
    with pytest.raises(InsufficientDataError, match="--search-s"):
        delay_from_images(replace(whole, images=change(whole.images)), RigidTransform.identity(), search_s)
