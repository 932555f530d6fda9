from dataclasses import replace

import numpy as np
import pytest
from fused_scenes import CENTRE_MM, errors, scene
from scipy.spatial.transform import RigidTransform

from speckle3d.core.relative import RelativePoses
from speckle3d.core.streams import TimedPoses
from speckle3d.correction.fused import images, sensors
from speckle3d.correction.fused.fuse import _sensors, fuse
from speckle3d.correction.fused.images import ImageEvidence
from speckle3d.correction.fused.settings import FusedSettings
from speckle3d.correction.fused.solution import Problem
from speckle3d.correction.scale import ScaleEvidence
from speckle3d.motion.trajectory import joined
from speckle3d.simulation.movement import HandMotion
from speckle3d.simulation.sensors import TrackerModel


def problem_of(made, tracker=None, orientation=None):
    centre = RigidTransform.from_translation(CENTRE_MM)
    start = centre.inv() * made.image * centre
    evidence = ImageEvidence.of(made.edges, start, made.covariance, made.scale_sigma, made.turn_sigma_per_mm)
    read = _sensors(start, CENTRE_MM, made.time_s, orientation, tracker, FusedSettings())
    return Problem.of(evidence, read, ())


def path_mm(poses):
    return float((poses[0].inv() * poses[-1]).apply(CENTRE_MM)[2])


def scaled(tracker, factor):
    poses = tracker.readings.world_from_sensor
    larger = RigidTransform.from_components(factor * poses.translation, poses.rotation)
    return replace(tracker, readings=TimedPoses(tracker.readings.time_s, larger))


def test_without_sensors_the_images_length_and_claim_remain():
    made = scene(1, frames=16, length_mm=2.0)
    found = fuse(*made.given())
    own = np.sqrt(made.covariance[-1, 2, 2])
    # A third of the claim: edges that share a changing scale are weighed a little otherwise.
    assert path_mm(found.poses) == pytest.approx(path_mm(made.image), abs=own / 3)
    assert found.used == ("images",)
    assert np.sqrt(found.covariance[-1, 2, 2]) == pytest.approx(own, rel=0.2)


def test_evidence_of_the_scale_counts_by_its_information_against_the_images_claim():
    made = scene(2, frames=16, length_mm=2.0, scale_sigma=0.05)
    told = ScaleEvidence("crossing", np.array([0.04, 0.0, 0.0]), np.diag([1.0 / 0.01**2, 0.0, 0.0]))
    alone, found = fuse(*made.given()), fuse(*made.given(), evidence=[told])
    # Variances of the mean scale before: common and changing parts; after: the evidence's own, nearly.
    prior, own = 0.05**2 * (1.0 + 2.0 / 2.0), 0.01**2
    assert found.log_scale - alone.log_scale == pytest.approx(0.04 * prior / (prior + own), abs=2e-3)
    assert 0.009 < found.log_scale_sigma < 0.5 * alone.log_scale_sigma
    assert found.used == ("images", "crossing")


@pytest.mark.slow
def test_a_tracker_that_sees_one_and_a_half_times_the_distance_is_named_and_allowed_for():
    made = scene(3, frames=40, length_mm=4.0, scale_sigma=0.02)
    honest, found = (fuse(*made.given(), tracker=scaled(made.tracker, k)) for k in (1.0, 1.5))
    assert not honest.contradictions
    (doubt,) = found.contradictions
    assert doubt.about == "tracker"
    assert not doubt.refuted
    true = path_mm(made.truth)
    # Either may be right: both ends are inside two claimed deviations.
    assert abs(np.log(true / path_mm(found.poses))) < 2.0 * found.log_scale_sigma
    assert np.sqrt(found.covariance[-1, 2, 2]) > abs(path_mm(found.poses) - true) / 2.0


def test_derivatives_of_all_equations_match_differences(monkeypatch):
    # Robust weights are held while equations are linearised.
    monkeypatch.setattr(images, "HUBER", 1e9)
    monkeypatch.setattr(sensors, "OUTLYING", 1e9)
    made = scene(4, frames=16, length_mm=2.0)
    problem = problem_of(made, made.tracker, made.orientation)
    state = problem.start()
    rng = np.random.default_rng(0)
    step = 1e-5 * rng.standard_normal(problem.size)
    ahead = problem._measured(state.moved(step, problem.sensors))
    behind = problem._measured(state.moved(-step, problem.sensors))
    for block, a, b in zip(problem._measured(state), ahead, behind, strict=True):
        wanted = (a.residual - b.residual).ravel() / 2
        # Twists' derivatives are those at no error: right to half the errors' angles, under a hundredth.
        np.testing.assert_allclose(
            block.jacobian(problem.size) @ step, wanted, atol=0.01 * np.abs(wanted).max()
        )


def test_directions_are_called_tied_only_where_visits_are_joined():
    made = scene(5, frames=24, length_mm=2.0, motion=HandMotion(reverse=True, pauses=0))
    z = made.image.apply(CENTRE_MM)[:, 2]
    apart = [(i, j) for i in range(5) for j in range(18, 24) if abs(z[i] - z[j]) < 0.5]
    first, second = np.array(apart).T
    local = RigidTransform.from_translation(CENTRE_MM)
    about = local.inv() * (made.truth[0].inv() * made.truth) * local
    tie = RelativePoses(
        first,
        second,
        about[first].inv() * about[second],
        np.tile(made.edges.covariance[0], (first.size, 1, 1)),
    )
    alone, tied = fuse(*made.given()), fuse(joined(made.edges, tie), *made.given()[1:])
    assert "directions" not in alone.details
    assert "unknown beyond what the images claim" in str(tied.details["directions"])
    assert abs(float(tied.details["direction_ratio"]) - 1.0) < 0.1


@pytest.mark.slow
def test_short_sweeps_with_a_tracker_are_longer_right_than_by_images_or_tracker_alone():
    by = {"images": [], "tracker": [], "fused": []}
    for seed in range(100, 110):
        made = scene(seed)
        true = path_mm(made.truth)
        sensed = made.tracker.world_from_image(made.time_s)
        for name, poses in (
            ("images", made.image),
            ("tracker", sensed),
            ("fused", fuse(*made.given(), tracker=made.tracker).poses),
        ):
            by[name].append(abs(path_mm(poses) / true - 1))
    medians = {name: float(np.median(values)) for name, values in by.items()}
    # Measured on seeds 0 to 11: 1.7 % by the images, 0.9 % fused.
    assert medians["fused"] < min(medians["images"], medians["tracker"])
    assert medians["fused"] < 0.015


@pytest.mark.slow
def test_claims_hold_with_both_sensors():
    inside = []
    for seed in range(200, 210):
        made = scene(seed)
        found = fuse(*made.given(), made.orientation, made.tracker)
        assert not found.contradictions
        inside.append(np.abs(errors(found.poses, made.truth)) / np.sqrt(np.diag(found.covariance[-1])))
    within = np.array(inside)
    # Of 60 in all: 68 and 95 %, with three deviations of counting.
    assert 0.5 < (within < 1.0).mean() < 0.95
    assert (within < 1.96).mean() > 0.86


@pytest.mark.slow
def test_outliers_of_a_tracker_do_not_move_the_poses():
    made = scene(7, tracker=TrackerModel(position_mm=0.1))
    poses = made.tracker.readings.world_from_sensor
    rng = np.random.default_rng(7)
    wild = rng.random(len(poses)) < 0.05
    moved = poses.translation + np.where(wild[:, None], rng.choice([-3.0, 3.0], (len(poses), 3)), 0.0)
    spoiled = replace(
        made.tracker,
        readings=TimedPoses(
            made.tracker.readings.time_s, RigidTransform.from_components(moved, poses.rotation)
        ),
    )
    clean, found = (fuse(*made.given(), tracker=each) for each in (made.tracker, spoiled))
    # Half of what is claimed; least squares would go five times as far.
    assert abs(path_mm(found.poses) - path_mm(clean.poses)) < 0.5 * np.sqrt(clean.covariance[-1, 2, 2])


@pytest.mark.slow
@pytest.mark.parametrize("with_tracker", [False, True])
def test_gtsam_finds_the_same_poses_and_covariance(with_tracker):
    pytest.importorskip("gtsam")
    from gtsam_twin import Twin

    made = scene(3, frames=24, length_mm=2.5)
    problem = problem_of(made, made.tracker if with_tracker else None)
    solution, problem = problem.solve()
    poses, covariance = Twin(problem, problem.start(), solution.sizes).solve()
    apart = np.linalg.inv(poses) @ solution.state.poses.as_matrix()
    sigma = np.sqrt(np.diag(covariance))
    ours = np.sqrt(np.diag(solution.covariance(np.array([23]))))[[3, 4, 5, 0, 1, 2]]
    # GTSAM has neither Huber's weights of the edges nor the common errors' tail: 0.03 of a deviation.
    assert np.abs(apart[:, :3, 3]).max() < 0.05 * sigma[3:].max()
    np.testing.assert_allclose(ours, sigma, rtol=0.03)
