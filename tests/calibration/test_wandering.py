"""Calibrations with sensors whose errors wander: whether claims are true, and nothing far off is accepted."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.calibration_errors import orientation, plane
from scipy.spatial.transform import RigidTransform

from calibration.chain import ANGLES, ImagePoints
from calibration.orientation import calibrate_orientation
from calibration.plane import LineDirections, calibrate_plane
from calibration.profile import widened
from calibration.solver import solve_chain
from speckle3d.core.errors import InsufficientDataError

DRIFT = (0.3, 0.2, 5.0)


def test_times_of_frames_tell_what_wanders():
    trial = plane.Trial(31, True, (0.05, 0.03), DRIFT)
    points, *_ = plane.scan(trial)
    noise = calibrate_plane(points).noise
    # 0.3 mm, and 0.2 degrees with an arm of some 100 mm, are 0.5 mm; over so few time constants, to a half.
    assert 0.2 < noise.wander < 1.2
    assert 1.0 < noise.time_s < 25.0
    slower = calibrate_plane(replace(points, time_s=10.0 * points.time_s)).noise
    assert slower.time_s == pytest.approx(10.0 * noise.time_s, rel=0.05)


@pytest.mark.slow
def test_errors_of_a_plane_calibration_with_a_drifting_tracker_lie_within_those_claimed():
    found = [plane.judged(plane.Trial(seed, True, (0.15, 0.1), DRIFT)) for seed in range(24)]
    scores = np.abs([one for one in found if one is not None])
    # In the others, of 8 to 17 s, the drift leaves a corner uncertain by more than 5 mm: refused.
    assert len(scores) >= 18
    # 160 figures, of which some 70 are independent: 68 and 95 % to 5 and 2.5; with one size of error and no
    # drift claimed they were 46 and 74 %.
    assert 0.58 <= np.mean(scores < 1.0) <= 0.80
    assert np.mean(scores < 1.96) >= 0.88


@pytest.mark.slow
def test_set_ups_at_random_end_in_no_wrong_minimum():
    found = [orientation.judged(orientation.Trial(seed, True)) for seed in range(24)]
    accepted = [one for one in found if not one.refused]
    assert len(accepted) >= 16
    assert max(one.wrong_deg / one.claimed_deg for one in accepted) < 4.0
    assert max(one.wrong_deg for one in accepted) < 10.0


def test_a_bent_valley_widens_what_is_claimed():
    # Little yaw: the mean square is as good 6.8 degrees away, where the curvature at the answer claims 1.4.
    directions, readings, _, time_s, _ = orientation.scan(orientation.Trial(2058, True))
    lines = ImagePoints(
        directions, np.arange(len(directions)), RigidTransform.from_rotation(readings), time_s=time_s
    )
    with pytest.raises(InsufficientDataError, match="rotate about the beam axis"):
        calibrate_orientation(directions, lines.frame, readings, np.ones(2), time_s=time_s)


def test_a_straight_valley_widens_nothing():
    directions, readings, mounting, time_s, _ = orientation.scan(orientation.Trial(3, False))
    found = calibrate_orientation(directions, np.arange(len(directions)), readings, np.ones(2), time_s=time_s)
    claimed = found.noise.covariance
    again = widened(found.points_used, found.phantom, found.chain, found.free, claimed)
    assert np.diag(again) == pytest.approx(np.diag(claimed), rel=0.2)
    assert isinstance(found.phantom, LineDirections)
    assert found.free[: len(ANGLES)] == ANGLES
    near = replace(found.chain, sensor_from_image=RigidTransform.from_rotation(mounting))
    other = solve_chain(found.points, found.phantom, near, ANGLES)
    step = other.chain.sensor_from_image.inv() * found.chain.sensor_from_image
    flipped = min(step.rotation.magnitude(), np.pi - step.rotation.magnitude())
    assert flipped < 1e-4
