"""Images, sensors and other evidence fused; that lengths and claims hold, the accuracy set asserts."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import RigidTransform
from spoiled_images import first_vectors, in_order

from speckle3d.core.errors import MismatchError
from speckle3d.core.reconstruction import SharedErrors
from speckle3d.core.streams import TimedPoses
from speckle3d.correction.fused import FusionProblem, fuse
from speckle3d.correction.scale import ScaleEvidence
from speckle3d.corrections import correct
from speckle3d.scoring.lengths import compare_modes
from speckle3d.tracking import track


def fuse_images(tracking, sweep, scale_sigma=0.03, **evidence):
    shared = SharedErrors(scale_sigma, 0.0, tracking.shared.turn_sigma_per_mm)
    centre = sweep.grid.centre_mm
    problem = FusionProblem.of(
        tracking.edges, tracking.image, 0.0, shared, centre, sweep.frame_time_s, **evidence
    )
    return fuse(problem, centre)


def displace(tracker, shift_mm=0.0, factor=1.0):
    poses = tracker.readings.world_from_sensor
    places = factor * poses.translation + shift_mm
    readings = TimedPoses(tracker.readings.time_s, RigidTransform.from_components(places, poses.rotation))
    return replace(tracker, readings=readings)


def test_evidence_of_the_scale_counts_by_its_information_against_the_images_claim(sweep, tracking):
    evidence = ScaleEvidence(np.array([0.04, 0.0, 0.0]), np.diag([1.0 / 0.01**2, 0.0, 0.0]))
    poses = fuse_images(tracking, sweep, 0.02, evidence=evidence)
    # Variances before: of the common scale, and of its changes along the sweep between nothing and as much.
    least, most = (0.04 * prior / (prior + 0.01**2) for prior in (0.02**2, 2 * 0.02**2))
    assert least - 5e-4 < poses.log_scale < most + 5e-4
    assert poses.length_sigma == pytest.approx(0.01, rel=0.2)
    assert poses.rests_on == ("images", "crossing")


def test_a_sensor_without_a_mounting_costs_itself_alone(sweep, tracking):
    loose = replace(sweep, orientation=replace(sweep.orientation, sensor_from_image=None))
    assert correct(tracking, loose, "fused")["fused"].rests_on == ("images", "tracker")


def test_a_loop_of_the_images_says_nothing_of_their_scale(sweep, curves):
    # Edges between both visits once made shrinking cheap: every edge counts in the images' own millimetres.
    loop = in_order(first_vectors(sweep), [*range(32), *range(31, -1, -1)])
    poses = fuse_images(track(loop, curves), loop)
    assert poses.log_scale == pytest.approx(0.0, abs=1e-3)
    assert poses.length_sigma > 0.8 * 0.03


def test_a_tracker_much_too_far_from_the_images_is_not_averaged_with_them(sweep, tracking):
    with pytest.raises(MismatchError):
        fuse_images(tracking, sweep, tracker=displace(sweep.tracker, factor=1e-3))


def test_outliers_of_a_tracker_move_the_poses_little(sweep, tracking):
    rng, many = np.random.default_rng(7), len(sweep.tracker.readings)
    wild = np.where(rng.random((many, 1)) < 0.05, rng.choice([-3.0, 3.0], (many, 3)), 0.0)
    clean, outliers = (
        fuse_images(tracking, sweep, tracker=displace(sweep.tracker, shift)) for shift in (0.0, wild)
    )
    ends = [(fit.poses[0].inv() * fit.poses[-1]).apply(sweep.grid.centre_mm)[2] for fit in (clean, outliers)]
    # A tenth of the readings near the end are off by ten claimed deviations of it and more.
    assert abs(ends[1] - ends[0]) < 2 * np.sqrt(clean.covariance[-1, 2, 2])


@pytest.mark.parametrize("mode", ["fused", "pose"])
def test_a_tracker_that_wanders_is_claimed_to(mode, sweep, tracking):
    rng, times = np.random.default_rng(11), sweep.tracker.readings.time_s
    errors = []
    for _ in range(8):
        wander = gaussian_filter1d(rng.normal(size=(times.size, 3)), times.size / 8, axis=0)
        tracker = displace(sweep.tracker, 0.5 * wander / wander.std())
        fit = correct(tracking, replace(sweep, tracker=tracker, orientation=None), mode)[mode]
        (row,) = compare_modes({mode: fit.poses}, sweep.truth, sweep.grid.centre_mm, end_frames=1)
        errors.append(row.length_error_percent / 100 / fit.length_sigma)
    assert np.linalg.norm(errors) < 3.4  # 1.2 rms
