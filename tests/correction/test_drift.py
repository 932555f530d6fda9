import numpy as np
import pytest
from drifting import CENTRE_MM, CORNERS_MM, drifting_poses, hand_sweep, tracker_poses

from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import elevational_steps, relative_poses, roll_yaw_tilt
from speckle3d.correction.drift import DriftSettings, correct_orientation, correct_pose

TIME, DISTANCE = DriftSettings(), DriftSettings(curves="distance")


def sweep(seed, frames=160, turns=0, outliers=0.0):
    rng = np.random.default_rng(seed)
    truth = hand_sweep(rng, frames, turns=turns)
    return truth, drifting_poses(truth, rng), tracker_poses(truth, rng, outliers=outliers)


def everywhere(poses):
    return np.ones(len(poses), dtype=bool)


def travel(poses, last=None):
    return elevational_steps(poses, CENTRE_MM)[:last].sum()


def total_tilt_deg(poses):
    return np.rad2deg(roll_yaw_tilt(relative_poses(poses).rotation)[:, 2].sum())


def medians(seeds, settings, half=False, **options):
    """Median length error in % and tilt error in degrees, pose by pose sensor."""
    errors = []
    for seed in seeds:
        truth, estimate, reference = sweep(seed, **options)
        poses = correct_pose(estimate, reference, everywhere(truth), CORNERS_MM, settings).poses
        last = int(np.argmax(np.cumsum(elevational_steps(truth, CENTRE_MM)))) + 1 if half else None
        error = 100 * abs(travel(poses, last) / travel(truth, last) - 1)
        errors.append((error, abs(total_tilt_deg(poses) - total_tilt_deg(truth))))
    return np.median(errors, axis=0)


# Bounds: twice the 0.14 to 0.3 % and 0.07 degrees measured on other seeds; uncorrected 15 % and 1.5 degrees.
@pytest.mark.parametrize("settings", [TIME, DISTANCE], ids=["time", "distance"])
@pytest.mark.parametrize("outliers", [0.0, 0.05])
def test_length_and_tilt_drift_are_removed_through_a_jittery_tracker(settings, outliers):
    length, tilt = medians(range(8), settings, outliers=outliers)
    assert length < 0.6
    assert tilt < 0.14


def test_at_a_reversal_distance_curves_follow_where_time_curves_cannot():
    length, _ = medians(range(6), DISTANCE, half=True, turns=1)
    time_curves, _ = medians(range(6), TIME, half=True, turns=1)
    assert length < 1.0
    # The drift's sign jumps at the turn; the best cubic in t through it leaves a fifth of 15 %.
    assert 1.5 < time_curves < 6.0


@pytest.mark.parametrize("settings", [TIME, DISTANCE], ids=["time", "distance"])
def test_orientation_correction_removes_tilt_and_keeps_every_step_of_the_centre(settings):
    truth, estimate, reference = sweep(40, turns=1)
    correction = correct_orientation(estimate, reference.rotation, everywhere(truth), CENTRE_MM, settings)
    before = relative_poses(estimate).apply(CENTRE_MM)
    np.testing.assert_allclose(relative_poses(correction.poses).apply(CENTRE_MM), before, atol=1e-9)
    angle = np.rad2deg((correction.poses.rotation.inv() * truth.rotation).magnitude())
    # Noise 0.1 degrees per axis, averaged by the curves; time curves miss the jump of the drift at the turn.
    assert np.median(angle) < (0.4 if settings is TIME else 0.12)
    assert np.abs(correction.curves[:, :3]).max() == 0.0


def test_raises_on_thin_coverage():
    _, estimate, reference = sweep(45, frames=100)
    for missing in (slice(30, 70), slice(0, 11), slice(85, 100), slice(0, 100)):
        has_reading = everywhere(estimate)
        has_reading[missing] = False
        with pytest.raises(InsufficientDataError):
            correct_orientation(estimate, reference.rotation, has_reading, CENTRE_MM)
    with pytest.raises(InsufficientDataError):
        correct_pose(estimate[:9], reference[:9], everywhere(estimate[:9]), CORNERS_MM)


def test_the_claims_of_pose_hold():
    size = []
    for seed in range(60, 72):
        truth, estimate, reference = sweep(seed)
        correction = correct_pose(estimate, reference, everywhere(truth), CORNERS_MM)
        ends = [p[0].inv() * p[-1] for p in (correction.poses, truth)]
        away = np.hstack(
            [
                ends[0].apply(CENTRE_MM) - ends[1].apply(CENTRE_MM),
                (ends[0].rotation * ends[1].rotation.inv()).as_rotvec(),
            ]
        )
        size.append(np.abs(away) / np.sqrt(np.diag(correction.covariance[-1])))
    ratio = np.array(size)
    assert ratio.max() < 4.0
    assert 0.5 < (ratio < 1.0).mean() < 0.95
