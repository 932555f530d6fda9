"""The delay between a plane's line and a sensor: simulated hands, ambiguous ones, a real recording."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.clock.line import delay_from_lines, line_signal
from calibration.detection.lines import detect_lines
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import load_sweep, open_recording

DELAY_S = 0.08


def hand(seed, count=5):
    """A smooth irregular motion: sines of frequencies that do not fit each other, amplitude about one."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.2, 2.0, count), rng.uniform(0, 2 * np.pi, count)
    return lambda t: np.sin(2 * np.pi * frequency * np.asarray(t)[..., None] + phase).sum(-1) / np.sqrt(count)


def simulate(seed, *, seconds=12.0, noise_mm=0.1, jitter_mm=0.1):
    """Line depth and slope in frames, and both kinds of readings whose clock is behind by `DELAY_S`."""
    rng = np.random.default_rng(seed)
    height, tilt = hand(seed), hand(seed + 1000)
    frames, sensor = np.arange(0.0, seconds, 1 / 25.0), np.arange(-1.0, seconds + 1.0, 1 / 256.0)
    skew = Rotation.from_rotvec([0.4, -0.2, 1.0])
    jitter = jitter_mm * rng.standard_normal((sensor.size, 3))
    place = skew.apply(np.outer(8.0 * height(sensor), [0.1, 0.0, 1.0]) + jitter)
    turn = Rotation.from_rotvec(np.outer(0.15 * tilt(sensor), skew.apply([0.0, 1.0, 0.0]))) * skew
    depth = 25.0 - 8.0 * height(frames) + noise_mm * rng.standard_normal(frames.size)
    slope = 0.15 * tilt(frames) + 0.003 * rng.standard_normal(frames.size)
    clock = sensor - DELAY_S
    poses = TimedPoses(clock, RigidTransform.from_components(place, turn))
    return np.column_stack([depth, slope]), frames, poses, TimedRotations(clock, turn)


@pytest.mark.parametrize("kind", ["tracker", "orientation"])
def test_a_delay_is_found_within_two_milliseconds(kind):
    for seed in range(3):
        signal, frames, poses, rotations = simulate(seed)
        delay = delay_from_lines(signal, frames, poses if kind == "tracker" else rotations)
        assert delay.seconds == pytest.approx(DELAY_S, abs=0.002)
        assert delay.followed > 0.9


def test_no_delay_of_another_motion_or_outside_the_range():
    signal, frames, poses, _ = simulate(0, noise_mm=0.01, jitter_mm=0.01)
    noise_signal = simulate(50, noise_mm=0.01)[0]
    for arguments in (
        (noise_signal, frames, poses),  # of another motion
        (signal, frames, poses, 0.0, 0.05),  # beyond the range searched
    ):
        with pytest.raises(InsufficientDataError):
            delay_from_lines(*arguments)
    assert delay_from_lines(signal, frames, poses, 0.1, 0.05).seconds == pytest.approx(DELAY_S, abs=0.002)


@pytest.mark.slow
@pytest.mark.realdata
def test_the_real_water_tank_has_the_published_delay(realdata):
    plus = realdata / "plus"
    settings = ImportSettings(column_pitch_mm=0.078, row_spacing_mm=0.078, dynamic_range_db=60.0)
    sweep = load_sweep(plus / "WaterTankBottomTranslationVideoBuffer.igs.mha", settings)
    readings = open_recording(plus / "WaterTankBottomTranslationTrackerBuffer.igs.mha").tracker.readings
    lines = detect_lines(sweep.frames, (0.078, 0.078))
    signal = line_signal(lines.pixels, np.array([0.078, 0.078]), 409.5)
    delay = delay_from_lines(signal, sweep.frame_time_s[lines.frame], readings)
    # PLUS: TrackerLagSec -0.0648266, the same delay with its sign the other way round. Measured 0.0652.
    assert delay.seconds == pytest.approx(0.0648266, abs=0.003)
