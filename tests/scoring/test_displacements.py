"""Displacement errors by hand, by brute force, by evo and by TUS-REC's published definition."""

import challenge_examples as examples
import numpy as np
import pytest
from drifting import CENTRE_MM, drifted, hand_sweep
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.sweep import ImageGrid
from speckle3d.io.challenge import Landmarks
from speckle3d.io.load import load_landmarks, load_sweep
from speckle3d.io.tum import write_tum
from speckle3d.scoring.displacements import (
    challenge_score,
    drift_rates,
    drift_rows,
    landmark_errors,
    pixel_errors,
    score_row,
)
from speckle3d.scoring.references import Reference, find_reference

ORIGIN = ImageGrid(1, 1, 1.0, 1.0)
"""An image of one pixel, at the origin of the poses."""


def sliding(length_mm, frames=51):
    return RigidTransform.from_translation(np.outer(np.linspace(0.0, length_mm, frames), [0.0, 0.0, 1.0]))


@pytest.mark.parametrize("grid", [ImageGrid(7, 11, 0.3, 0.05, 2.0), ImageGrid(1, 9, 1.0, 4.0)])
def test_the_pixels_are_all_pixels(grid):
    rng = np.random.default_rng(8)
    truth = hand_sweep(rng, 12)
    estimate = drifted(truth, rng)
    pixels = [
        [grid.vector_pitch_mm * i, grid.first_sample_depth_mm + grid.sample_spacing_mm * k, 0.0]
        for i in range(grid.vectors)
        for k in range(grid.samples)
    ]
    found, true = (p[0].inv() * p for p in (estimate, truth))
    whole = [np.linalg.norm(found[i].apply(p) - true[i].apply(p)) for i in range(1, 12) for p in pixels]
    steps = [
        np.linalg.norm((found[i - 1].inv() * found[i]).apply(p) - (true[i - 1].inv() * true[i]).apply(p))
        for i in range(1, 12)
        for p in pixels
    ]
    errors = pixel_errors(estimate, truth, grid)
    assert errors.global_mm == pytest.approx(np.mean(whole), abs=1e-12)
    assert errors.local_mm == pytest.approx(np.mean(steps), abs=1e-12)


def test_pixels_and_landmarks_of_a_known_turn():
    """Frame 1 is turned by 90 degrees about z and stays so; by hand, p moves by sqrt(2) of its distance."""
    turned = RigidTransform.from_rotation(Rotation.from_euler("z", [[0.0], [90.0], [90.0]], degrees=True))
    still = RigidTransform.identity(3)
    # Frame 2 sits on frame 1, so that its step is right and its place is not.
    marks = landmark_errors(turned, still, Landmarks(np.array([1, 2]), np.array([[3.0, 4, 0], [0, 10, 0]])))
    assert marks.global_mm == pytest.approx(np.sqrt(2) * (5.0 + 10.0) / 2)
    assert marks.local_mm == pytest.approx(np.sqrt(2) * (5.0 + 0.0) / 2)
    pixels = pixel_errors(turned, still, ImageGrid(2, 2, 3.0, 4.0))
    # Corners at distances 0, 3, 4 and 5 mm of the origin.
    assert pixels.global_mm == pytest.approx(np.sqrt(2) * (0 + 3 + 4 + 5) / 4)
    assert pixels.local_mm == pytest.approx(pixels.global_mm / 2)


def test_the_hausdorff_distance_by_hand():
    def at(*x):
        return RigidTransform.from_translation([[value, 0.0, 0.0] for value in x])

    # 7 is 3 from the nearest of 0, 1, 4; of these, 4 is 2 from 2, the nearest other.
    assert drift_rates(at(0.0, 2.0, 7.0), at(0.0, 1.0, 4.0), np.zeros(3))["HD_mm"] == pytest.approx(3.0)
    assert drift_rates(at(0.0, 1.0, 4.0), at(0.0, 2.0, 7.0), np.zeros(3))["HD_mm"] == pytest.approx(3.0)
    # The same places in another order: each centre drifts, and none is far from the other set.
    back = drift_rates(at(0.0, 4.0, 1.0), at(0.0, 1.0, 4.0), np.zeros(3))
    assert (back["HD_mm"], back["MD_mm"]) == pytest.approx((0.0, 3.0))


def test_rates_are_of_the_path_travelled_not_of_the_way_gained():
    def at(*z):
        return RigidTransform.from_translation([[0.0, 0.0, value] for value in z])

    # There and back: the path is 1, then 2 mm long; drifts are 0.1 and 0.3 mm.
    rates = drift_rates(at(0.0, 1.1, 0.3), at(0.0, 1.0, 0.0), CENTRE_MM)
    assert rates["FDR_percent"] == pytest.approx(100 * 0.3 / 2)
    assert rates["ADR_percent"] == pytest.approx(100 * (0.1 / 1 + 0.3 / 2) / 2)
    assert (rates["MD_mm"], rates["SD_mm"]) == pytest.approx((0.3, 0.4))


def test_the_error_of_angle_is_about_one_axis_whichever():
    """Turns about two axes: the angle is of the whole turn, neither a sum nor a mean of components."""
    turn = Rotation.from_rotvec(np.deg2rad([[0.0, 0, 0], [3.0, 4.0, 0.0], [0.0, 0.0, -1.0]]))
    rates = drift_rates(sliding(2.0, 3) * RigidTransform.from_rotation(turn), sliding(2.0, 3), np.zeros(3))
    assert rates["EA_deg"] == pytest.approx((5.0 + 1.0) / 2)


@pytest.mark.parametrize(
    ("frames", "message"), [([], "landmarks"), ([1, 0], "landmark 1.*0"), ([51], "landmark 0.*1 to 50.*51")]
)
def test_a_landmark_that_has_no_error_is_refused(frames, message):
    marks = Landmarks(np.array(frames, dtype=int), np.zeros((len(frames), 3)))
    with pytest.raises(InvalidInputError, match=message):
        landmark_errors(sliding(1.0), sliding(1.0), marks)


def test_neither_world_matters():
    rng = np.random.default_rng(1)
    truth = hand_sweep(rng, 40)
    estimate = drifted(truth, rng)
    world = RigidTransform.from_components([9.0, -80.0, 3.0], Rotation.random(rng=rng))
    grid = ImageGrid(3, 4, 10.0, 10.0)
    here, there = pixel_errors(estimate, truth, grid), pixel_errors(world * estimate, truth, grid)
    assert (here.global_mm, here.local_mm) == pytest.approx((there.global_mm, there.local_mm))
    assert here.global_mm > 0.5


def test_a_rest_at_the_start_is_left_out_of_the_average_rate():
    still = RigidTransform.concatenate([sliding(100.0)[:1], sliding(100.0)])
    stretched = RigidTransform.concatenate([sliding(105.0)[:1], sliding(105.0)])
    assert drift_rates(stretched, still, CENTRE_MM)["ADR_percent"] == pytest.approx(5.0)


def test_a_reference_at_rest_or_of_another_length_is_refused():
    with pytest.raises(InsufficientDataError):
        drift_rates(sliding(1.0), RigidTransform.identity(51), CENTRE_MM)
    with pytest.raises(MismatchError, match=r"reference.*51.*50"):
        pixel_errors(sliding(1.0), sliding(1.0)[1:], ORIGIN)


def test_drift_of_a_uniform_stretch():
    """A straight sweep stretched by 5 % has FDR = ADR = 5 %, MD = 0.05 L, EA = 0."""
    reference = Reference("truth", sliding(20.0, 41), np.ones(41, dtype=bool))
    (row,) = drift_rows(ImageGrid(26, 1000, 0.3, 0.0193), {"image": sliding(21.0, 41)}, reference)
    # Mean of 0.05 z over frames 1 to 40 is 0.05 x 20 x 41 / 80; steps differ by 0.05 x 0.5 mm.
    expected = {
        "FDR_percent": 5.0,
        "ADR_percent": 5.0,
        "MD_mm": 1.0,
        "SD_mm": 20.5,
        "HD_mm": 1.0,
        "EA_deg": 0.0,
    }
    expected |= {"GPE_mm": 0.5125, "LPE_mm": 0.025}
    assert {name: row[name] for name in expected} == pytest.approx(expected, abs=1e-9)


@pytest.fixture(scope="module")
def trajectories(tmp_path_factory):
    file_interface = pytest.importorskip("evo.tools.file_interface", reason="evo is not installed")
    rng = np.random.default_rng(7)
    truth = hand_sweep(rng, 40)
    pair = [poses[0].inv() * poses for poses in (truth, drifted(truth, rng))]
    folder = tmp_path_factory.mktemp("evo")
    for name, poses in zip("te", pair, strict=True):
        write_tum(folder / name, np.arange(40) / 30.0, poses, "mm")
    return pair, tuple(file_interface.read_tum_trajectory_file(str(folder / name)) for name in "te")


def of_evo(metric, relation, trajectories, *more):
    metrics = pytest.importorskip("evo.core.metrics", reason="evo is not installed")
    metric = getattr(metrics, metric)(metrics.PoseRelation[relation], *more)
    metric.process_data(trajectories)
    return np.asarray(metric.error)


def test_drift_of_the_origin_is_the_absolute_pose_error(trajectories):
    (truth, estimate), texts = trajectories
    ours = drift_rates(estimate, truth, np.zeros(3))
    shift = of_evo("APE", "translation_part", texts)
    angle = of_evo("APE", "rotation_angle_deg", texts)
    path = texts[0].distances
    assert ours["MD_mm"] == pytest.approx(shift.max(), abs=1e-9)
    assert ours["SD_mm"] == pytest.approx(shift.sum(), abs=1e-9)
    assert ours["FDR_percent"] == pytest.approx(100 * shift[-1] / path[-1], abs=1e-7)
    assert ours["EA_deg"] == pytest.approx(angle[1:].mean(), abs=1e-9)


def test_pixel_errors_of_the_origin_are_absolute_and_relative_pose_errors(trajectories):
    (truth, estimate), texts = trajectories
    ours = pixel_errors(estimate, truth, ORIGIN)
    whole = of_evo("APE", "translation_part", texts)
    steps = of_evo("RPE", "translation_part", texts)
    assert ours.global_mm == pytest.approx(whole[1:].mean(), abs=1e-9)
    # evo's error is that of E = true_step^-1 * step, whose translation is as long as the steps' difference.
    assert ours.local_mm == pytest.approx(steps.mean(), abs=1e-9)


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return examples.write_data_set(tmp_path_factory.mktemp("challenge"))


@pytest.fixture(scope="module")
def estimate(scan):
    """A drifting estimate, as poses of the image and of the tool in the challenge's own terms."""
    sweep = load_sweep(scan[0])
    poses = drifted(find_reference(sweep, None).world_from_image, np.random.default_rng(4))
    counted_from_ours = RigidTransform.from_translation([*examples.SCALE_MM, 0.0]).as_matrix()
    tool = poses.as_matrix() @ np.linalg.inv(counted_from_ours) @ np.linalg.inv(examples.TOOL_FROM_IMAGE)
    return poses, tool


def test_the_four_errors_are_the_published_ones(scan, estimate):
    path, _, true_tool, marks = scan
    sweep, (poses, tool) = load_sweep(path), estimate
    expected = examples.published_errors(true_tool, tool, marks)
    assert min(expected.values()) > 0.01
    (row,) = drift_rows(sweep.grid, {"image": poses}, find_reference(sweep, None), load_landmarks(path))
    assert {name: row[name] for name in expected} == pytest.approx(expected, abs=1e-9)


def test_the_final_score_is_the_published_one(scan, estimate):
    path, _, true_tool, marks = scan
    sweep, marked = load_sweep(path), load_landmarks(path)
    true = find_reference(sweep, None).world_from_image
    found = examples.published_errors(true_tool, estimate[1], marks)
    largest = examples.published_errors(true_tool, np.tile(np.eye(4), (len(true_tool), 1, 1)), marks)
    expected = np.mean([(found[key] - largest[key]) / (0.0 - largest[key]) for key in found])
    assert challenge_score(estimate[0], true, sweep.grid, marked) == pytest.approx(expected, abs=1e-9)
    assert challenge_score(true, true, sweep.grid, marked) == pytest.approx(1.0)
    assert challenge_score(RigidTransform.identity(len(true)), true, sweep.grid, marked) == pytest.approx(0.0)
    with pytest.raises(InsufficientDataError, match="GPE_mm"):
        challenge_score(true, RigidTransform.identity(len(true)), sweep.grid, marked)


def test_without_landmarks_there_are_no_errors_at_landmarks(scan, estimate):
    sweep = load_sweep(scan[0])
    found = score_row(estimate[0], find_reference(sweep, None).world_from_image, sweep.grid)
    assert (found["GLE_mm"], found["LLE_mm"]) == (None, None)
