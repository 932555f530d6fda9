"""The sensor's clock: an offset is found within its claimed error, from lines of a moving hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from calibration_examples import BEAM_DOWN, COLUMNS, PIXEL_MM, TRIAL_1, about
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.chain import ImagePoints
from calibration.clock.offset import covered, estimate_offset
from calibration.orientation import calibrate_orientation
from calibration.plane import calibrate_plane
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.streams import TimedPoses, TimedRotations

OFFSET_S = 0.08
SECONDS, FRAMES_HZ, SENSOR_HZ = 40.0, 2.5, 50.0
SEARCH_S = 0.14
NOISE_MM = 0.2


def hand(seed, time_s):
    """Pose of an image over the floor of a bath: sums of sines with periods of 1.5 to 8 s, and its up."""
    rng = np.random.default_rng(seed)

    def swing(reach):
        frequency, phase = 1.0 / rng.uniform(1.5, 8.0, 5), rng.uniform(0, 2 * np.pi, 5)
        share = 1.5 * rng.dirichlet(np.ones(5))
        return reach * share @ np.sin(2 * np.pi * np.outer(frequency, time_s) + phase[:, None])

    tilt, roll, yaw = (np.deg2rad(swing(reach)) for reach in (25.0, 15.0, 60.0))
    turn = about(2, yaw) * BEAM_DOWN * about(2, roll) * about(0, tilt)
    up = turn.inv().apply([0.0, 0.0, 1.0])
    height = (23.0 + swing(8.0)) * np.abs(up[:, 1])
    return RigidTransform.from_components(np.column_stack([swing(30.0), swing(30.0), height]), turn), up


def record(seed, offset_s=OFFSET_S, noise_mm=NOISE_MM):
    """Times of the frames, two points of the floor's line in each, and a tracker whose clock is behind."""
    frame_s = np.arange(0, SECONDS, 1 / FRAMES_HZ)
    image, up = hand(seed, frame_s)
    ends = np.array([0.0, COLUMNS - 1.0])
    rows = -(image.translation[:, 2:] + up[:, :1] * ends * PIXEL_MM[0]) / up[:, 1:2]
    rows += noise_mm * np.random.default_rng([seed, 3]).standard_normal(rows.shape)
    pixels = np.stack([np.broadcast_to(ends, rows.shape), rows / PIXEL_MM[1]], axis=-1)
    sensor_s = np.arange(-1.0, SECONDS + 1.0, 1 / SENSOR_HZ)
    return frame_s, pixels, TimedPoses(sensor_s - offset_s, hand(seed, sensor_s)[0] * TRIAL_1.inv())


def tracker_solver(frame_s, pixels, readings):
    def calibrate(offset_s):
        poses = readings.at(frame_s - offset_s)
        return calibrate_plane(ImagePoints.of_lines(np.arange(len(frame_s)), pixels, poses))

    return calibrate


def orientation_solver(frame_s, pixels, readings):
    turns = TimedRotations(readings.time_s, readings.world_from_sensor.rotation)

    def calibrate(offset_s):
        along = pixels[:, 1] - pixels[:, 0]
        return calibrate_orientation(along, np.arange(len(frame_s)), turns.at(frame_s - offset_s), PIXEL_MM)

    return calibrate


@pytest.mark.parametrize(
    ("solver", "seed"),
    [
        (tracker_solver, 0),
        pytest.param(tracker_solver, 1, marks=pytest.mark.slow),
        (orientation_solver, 0),
        pytest.param(orientation_solver, 1, marks=pytest.mark.slow),
    ],
)
def test_a_clock_that_is_off_is_found_within_the_claimed_error(solver, seed):
    found = estimate_offset(solver(*record(seed)), search_s=SEARCH_S)
    # Over 70 recordings an orientation sensor's clock erred by 1.2 times what is claimed; three of those.
    assert abs(found.seconds - OFFSET_S) < 3.6 * found.standard_error_s
    # Hands turn by some 20 degrees/s: 0.3 degrees or 0.2 mm in 100 frames are a few milliseconds.
    assert found.standard_error_s < (0.002 if solver is tracker_solver else 0.006)


def stub(residuals_at, refused=lambda offset_s: False):
    """A calibration whose residuals are known."""

    def calibrate(offset_s):
        if refused(offset_s):
            raise InsufficientDataError("the motion does not determine the calibration")
        residuals = residuals_at(offset_s)
        sigma = float(np.sqrt(np.mean(residuals**2)))
        return SimpleNamespace(residuals=residuals, used=np.ones(len(residuals), dtype=bool), sigma=sigma)

    return calibrate


def linear(rng, truth_s, shape, speed_mm_s=30.0):
    slope, noise = speed_mm_s * rng.standard_normal(shape), 0.5 * rng.standard_normal(shape)
    return slope, lambda offset_s: noise + slope * (offset_s - truth_s)


@pytest.mark.parametrize("components", [1, 3])
def test_the_claimed_error_counts_every_component_of_a_residual_once(components):
    scores = []
    for seed in range(60):
        slope, residuals_at = linear(np.random.default_rng(seed), 0.0734, (150, components))
        found = estimate_offset(stub(residuals_at))
        # Residuals that are linear in the offset: regression's own standard error.
        expected = np.sqrt(np.mean(residuals_at(found.seconds) ** 2) / np.sum(slope**2))
        assert found.standard_error_s == pytest.approx(expected, rel=0.01)
        scores.append((found.seconds - 0.0734) / found.standard_error_s)
    # The standard deviation of 60 is known to 9 %; three times that.
    assert np.std(scores) == pytest.approx(1.0, abs=0.27)


@pytest.mark.parametrize("truth_s", [0.4, -0.4, 0.385, 0.9, 0.35, -0.35, 0.0])
def test_nothing_is_asked_for_outside_the_range_and_its_ends_are_refused(truth_s):
    _, residuals_at = linear(np.random.default_rng(0), truth_s, (100, 1))
    tried = []

    def residuals(offset_s):
        tried.append(offset_s)
        return residuals_at(offset_s)

    if abs(truth_s) > 0.35:
        with pytest.raises(InsufficientDataError, match=r"0.4 s of 0 s"):
            estimate_offset(stub(residuals))
    else:
        assert estimate_offset(stub(residuals)).seconds == pytest.approx(truth_s, abs=0.01)
    # There may be no readings outside the range.
    assert np.abs(tried).max() <= 0.4 + 1e-12


def test_a_clock_is_looked_for_around_what_is_known_of_it():
    _, residuals_at = linear(np.random.default_rng(0), 0.9, (100, 1))
    assert estimate_offset(stub(residuals_at), around_s=0.8, search_s=0.2).seconds == pytest.approx(
        0.9, abs=0.01
    )
    with pytest.raises(InsufficientDataError, match=r"0.1 s of 1.1 s"):
        estimate_offset(stub(residuals_at), around_s=1.1, search_s=0.1)


def test_offsets_without_a_calibration_do_not_count():
    _, residuals_at = linear(np.random.default_rng(0), 0.1, (100, 1))
    found = estimate_offset(stub(residuals_at, refused=lambda offset_s: abs(offset_s - 0.1) > 0.15))
    assert found.seconds == pytest.approx(0.1, abs=0.01)
    with pytest.raises(InsufficientDataError, match=r"0.4 s"):
        estimate_offset(stub(residuals_at, refused=lambda offset_s: True))


def test_a_still_hand_tells_no_time():
    noise = np.random.default_rng(0).standard_normal((50, 1))
    # No offset is better than another: either the end of the range is met first, or nothing is claimed.
    try:
        found = estimate_offset(stub(lambda offset_s: noise))
    except InsufficientDataError:
        return
    assert np.isinf(found.standard_error_s)


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), slack_s=st.sampled_from([0.0, 0.05, 0.4]))
def test_covered_frames_have_a_reading_at_every_offset_that_may_be_tried(seed, slack_s):
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, 10.0, 0.02)
    # Dropouts shorter and longer than what is bridged, and than the slack.
    for start, length in zip(rng.uniform(0, 10, 4), rng.uniform(0.05, 1.0, 4), strict=True):
        time_s = time_s[(time_s < start) | (time_s > start + length)]
    readings = TimedRotations(time_s, Rotation.identity(len(time_s)))
    frame_s, offset_s = np.arange(-1.0, 11.0, 0.04), rng.uniform(-0.2, 0.2)
    there = covered(readings, frame_s, offset_s, slack_s)
    shifts = np.linspace(-slack_s, slack_s, 41 if slack_s else 1)
    always = np.all([readings.covers(frame_s - offset_s - shift) for shift in shifts], axis=0)
    np.testing.assert_array_equal(there, always)


def test_dropouts_of_the_sensor_are_left_out_and_the_clock_is_still_found():
    frame_s, pixels, readings = record(1)
    seen = np.ones(len(readings), dtype=bool)
    for start_s in (5.0, 17.3, 30.1):
        # Shorter than twice the range searched: frames amid it have readings at both ends of the range.
        seen &= (readings.time_s < start_s) | (readings.time_s > start_s + 0.3)
    gappy = TimedPoses(readings.time_s[seen], readings.world_from_sensor[seen])
    there = covered(gappy, frame_s, 0.0, SEARCH_S)
    # Three gaps of 0.3 s and what is searched to either side; there are readings beyond both ends.
    assert (~there).sum() == pytest.approx(3 * (0.3 + 2 * SEARCH_S) * FRAMES_HZ, abs=3)
    found = estimate_offset(orientation_solver(frame_s[there], pixels[there], gappy), search_s=SEARCH_S)
    assert abs(found.seconds - OFFSET_S) < 3.6 * found.standard_error_s
