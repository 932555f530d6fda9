from dataclasses import replace

import numpy as np
import pytest
from fused_scenes import CENTRE_MM, errors, scene
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import MismatchError
from speckle3d.core.streams import TimedPoses
from speckle3d.correction.fused import fuse
from speckle3d.correction.scale import ScaleEvidence
from speckle3d.simulation.movement import HandMotion


def path_mm(poses):
    return float((poses[0].inv() * poses[-1]).apply(CENTRE_MM)[2])


def moved(tracker, shift_mm=0.0, factor=1.0):
    poses = tracker.readings.world_from_sensor
    places = factor * poses.translation + shift_mm
    readings = TimedPoses(tracker.readings.time_s, RigidTransform.from_components(places, poses.rotation))
    return replace(tracker, readings=readings)


def test_evidence_of_the_scale_counts_by_its_information_against_the_images_claim():
    made = scene(2, frames=16, length_mm=2.0, scale_sigma=0.05)
    told = ScaleEvidence("crossing", np.array([0.04, 0.0, 0.0]), np.diag([1.0 / 0.01**2, 0.0, 0.0]))
    found = fuse(*made.given(), evidence=[told])
    # Variances of the mean scale before: common and changing parts; after: the evidence's own, nearly.
    prior, own = 0.05**2 * (1.0 + 2.0 / 2.0), 0.01**2
    assert found.log_scale == pytest.approx(0.04 * prior / (prior + own), abs=2e-3)
    assert found.log_scale_sigma == pytest.approx(0.01, rel=0.2)
    assert found.used == ("images", "crossing")


def test_a_loop_of_the_images_says_nothing_of_their_scale():
    # Edges between both visits once made shrinking cheap: every edge counts in the images' own millimetres.
    made = scene(5, frames=40, length_mm=4.0, motion=HandMotion(reverse=True, pauses=0))
    found = fuse(*made.given(), made.orientation)
    assert found.log_scale == pytest.approx(0.0, abs=1e-3)
    assert found.log_scale_sigma > 0.8 * made.scale_sigma


def test_a_tracker_much_too_far_from_the_images_is_not_averaged_with_them():
    made = scene(3, frames=40, length_mm=4.0)
    with pytest.raises(MismatchError, match=r"times as far: compare modes"):
        fuse(*made.given(), tracker=moved(made.tracker, factor=1e-3))


LENGTHS = {"short": (60, 5.0), "long": (240, 20.0)}


@pytest.mark.slow
@pytest.mark.parametrize("case", LENGTHS)
def test_with_a_tracker_lengths_are_no_worse_than_the_better_of_both_and_their_claims_hold(case):
    frames, length_mm = LENGTHS[case]
    found = {"images": [], "tracker": [], "fused": []}
    inside = []
    for seed in range(100, 112):
        made = scene(seed, frames=frames, length_mm=length_mm)
        both = fuse(*made.given(), made.orientation, made.tracker)
        sensed = made.tracker.world_from_image(made.time_s)
        for name, poses in (("images", made.image), ("tracker", sensed), ("fused", both.poses)):
            found[name].append(100 * (path_mm(poses) / path_mm(made.truth) - 1))
        inside.append(np.abs(errors(both.poses, made.truth)) / np.sqrt(np.diag(both.covariance[-1])))
    rms = {name: float(np.sqrt(np.mean(np.square(values)))) for name, values in found.items()}
    assert rms["fused"] < 1.1 * min(rms["images"], rms["tracker"])
    lengths = np.array(inside)[:, 2]
    assert lengths.max() < 3.0
    # Measured: 1.1 claims rms at 20 mm.
    assert np.sqrt(np.mean(lengths**2)) < 1.5


@pytest.mark.slow
def test_outliers_of_a_tracker_move_the_poses_little():
    made = scene(7, noise=0.7)
    rng = np.random.default_rng(7)
    many = len(made.tracker.readings.time_s)
    wild = np.where(rng.random((many, 1)) < 0.05, rng.choice([-3.0, 3.0], (many, 3)), 0.0)
    clean = fuse(*made.given(), tracker=made.tracker)
    spiked = fuse(*made.given(), tracker=moved(made.tracker, wild))
    assert abs(path_mm(spiked.poses) - path_mm(clean.poses)) < np.sqrt(clean.covariance[-1, 2, 2])
