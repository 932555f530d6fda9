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
    MEANINGS,
    challenge_score,
    drift_rates,
    landmark_errors,
    pixel_errors,
    score_row,
)
from speckle3d.scoring.references import find_reference

ORIGIN = ImageGrid(1, 1, 1.0, 1.0)
"""An image of one pixel, at the origin of the poses."""


def sliding(length_mm, frames=51):
    return RigidTransform.from_translation(np.outer(np.linspace(0.0, length_mm, frames), [0.0, 0.0, 1.0]))


def at(*z):
    return RigidTransform.from_translation([[0.0, 0.0, value] for value in z])


@pytest.mark.parametrize("grid", [ImageGrid(7, 11, 0.3, 0.05, 2.0), ImageGrid(1, 9, 1.0, 4.0)])
def test_the_pixels_are_all_pixels_and_neither_world_matters(grid):
    rng = np.random.default_rng(8)
    truth = hand_sweep(rng, 12)
    estimate = drifted(truth, rng)
    x, y = (np.arange(grid.vectors) * grid.vector_pitch_mm, np.arange(grid.samples) * grid.sample_spacing_mm)
    pixels = np.array([[a, grid.first_sample_depth_mm + b, 0.0] for a in x for b in y])
    whole, steps = [], []
    for i in range(1, 12):
        moved = [(p[0].inv() * p[i]).apply(pixels) for p in (estimate, truth)]
        stepped = [(p[i - 1].inv() * p[i]).apply(pixels) for p in (estimate, truth)]
        whole.append(np.linalg.norm(moved[0] - moved[1], axis=1))
        steps.append(np.linalg.norm(stepped[0] - stepped[1], axis=1))
    expected = np.mean(whole), np.mean(steps)
    assert pixel_errors(estimate, truth, grid) == pytest.approx(expected, abs=1e-12)
    world = RigidTransform.from_components([9.0, -80.0, 3.0], Rotation.random(rng=rng))
    assert pixel_errors(world * estimate, truth, grid) == pytest.approx(expected, abs=1e-9)


def test_landmarks_of_a_known_turn():
    """Frame 1 is turned by 90 degrees about z and stays so; by hand, p moves by sqrt(2) of its distance."""
    turned = RigidTransform.from_rotation(Rotation.from_euler("z", [[0.0], [90.0], [90.0]], degrees=True))
    still = RigidTransform.identity(3)
    # Frame 2 sits on frame 1, so that its step is right and its place is not.
    marks = landmark_errors(turned, still, Landmarks(np.array([1, 2]), np.array([[3.0, 4, 0], [0, 10, 0]])))
    assert marks == pytest.approx((np.sqrt(2) * (5.0 + 10.0) / 2, np.sqrt(2) * 5.0 / 2))


def test_drift_by_hand():
    # There and back: the path is 1, then 2 mm long; drifts are 0.1 and 0.3 mm.
    rates = drift_rates(at(0.0, 1.1, 0.3), at(0.0, 1.0, 0.0), CENTRE_MM)
    assert rates["FDR_percent"] == pytest.approx(100 * 0.3 / 2)
    assert rates["ADR_percent"] == pytest.approx(100 * (0.1 / 1 + 0.3 / 2) / 2)
    assert (rates["MD_mm"], rates["SD_mm"]) == pytest.approx((0.3, 0.4))
    # 7 is 3 from the nearest of 0, 1, 4; of these, 4 is 2 from 2, the nearest other.
    for pair in ((at(0.0, 2.0, 7.0), at(0.0, 1.0, 4.0)), (at(0.0, 1.0, 4.0), at(0.0, 2.0, 7.0))):
        assert drift_rates(*pair, np.zeros(3))["HD_mm"] == pytest.approx(3.0)
    # Turns about two axes: the angle is of the whole turn, neither a sum nor a mean of components.
    turn = Rotation.from_rotvec(np.deg2rad([[0.0, 0, 0], [3.0, 4.0, 0.0], [0.0, 0.0, -1.0]]))
    rates = drift_rates(sliding(2.0, 3) * RigidTransform.from_rotation(turn), sliding(2.0, 3), np.zeros(3))
    assert rates["EA_deg"] == pytest.approx((5.0 + 1.0) / 2)
    # A rest at the start is left out of the average rate.
    rested = [RigidTransform.concatenate([sliding(x)[:1], sliding(x)]) for x in (105.0, 100.0)]
    assert drift_rates(*rested, CENTRE_MM)["ADR_percent"] == pytest.approx(5.0)


def test_a_straight_sweep_stretched_by_five_per_cent():
    row = score_row(sliding(21.0, 41), sliding(20.0, 41), ImageGrid(26, 1000, 0.3, 0.0193))
    # Mean of 0.05 z over frames 1 to 40 is 0.05 x 20 x 41 / 80; steps differ by 0.05 x 0.5 mm.
    expected = {"FDR_percent": 5.0, "ADR_percent": 5.0, "MD_mm": 1.0, "SD_mm": 20.5, "HD_mm": 1.0,
                "EA_deg": 0.0, "GPE_mm": 0.5125, "LPE_mm": 0.025}  # fmt: skip
    assert {name: row[name] for name in expected} == pytest.approx(expected, abs=1e-9)
    assert (row["GLE_mm"], row["LLE_mm"]) == (None, None)
    assert row.keys() == MEANINGS.keys()


@pytest.mark.parametrize(
    ("frames", "message"), [([], "landmarks"), ([1, 0], "landmark 1.*0"), ([51], "landmark 0.*1 to 50.*51")]
)
def test_a_landmark_that_has_no_error_is_refused(frames, message):
    marks = Landmarks(np.array(frames, dtype=int), np.zeros((len(frames), 3)))
    with pytest.raises(InvalidInputError, match=message):
        landmark_errors(sliding(1.0), sliding(1.0), marks)


def test_a_reference_at_rest_or_of_another_length_is_refused():
    with pytest.raises(InsufficientDataError):
        drift_rates(sliding(1.0), RigidTransform.identity(51), CENTRE_MM)
    with pytest.raises(MismatchError, match=r"reference.*51.*50"):
        pixel_errors(sliding(1.0), sliding(1.0)[1:], ORIGIN)


def test_errors_of_the_origin_are_evos(tmp_path):
    files = pytest.importorskip("evo.tools.file_interface", reason="evo is not installed")
    metrics = pytest.importorskip("evo.core.metrics", reason="evo is not installed")
    rng = np.random.default_rng(7)
    truth = hand_sweep(rng, 40)
    pair = [poses[0].inv() * poses for poses in (truth, drifted(truth, rng))]
    for name, poses in zip("te", pair, strict=True):
        write_tum(tmp_path / name, np.arange(40) / 30.0, poses, "mm")
    texts = tuple(files.read_tum_trajectory_file(str(tmp_path / name)) for name in "te")

    def of_evo(metric, relation):
        made = getattr(metrics, metric)(metrics.PoseRelation[relation])
        made.process_data(texts)
        return np.asarray(made.error)

    shift, angle = (of_evo("APE", relation) for relation in ("translation_part", "rotation_angle_deg"))
    drift = drift_rates(pair[1], pair[0], np.zeros(3))
    assert (drift["MD_mm"], drift["SD_mm"]) == pytest.approx((shift.max(), shift.sum()), abs=1e-9)
    assert drift["FDR_percent"] == pytest.approx(100 * shift[-1] / texts[0].distances[-1], abs=1e-7)
    assert drift["EA_deg"] == pytest.approx(angle[1:].mean(), abs=1e-9)
    # evo's relative error is that of E = true_step^-1 * step, as long as the steps' difference.
    expected = shift[1:].mean(), of_evo("RPE", "translation_part").mean()
    assert pixel_errors(pair[1], pair[0], ORIGIN) == pytest.approx(expected, abs=1e-9)


def test_errors_and_score_are_those_the_challenge_publishes(tmp_path):
    path, _, true_tool, published = examples.write_data_set(tmp_path)
    sweep, marks = load_sweep(path), load_landmarks(path)
    true = find_reference(sweep, None).world_from_image
    poses = drifted(true, np.random.default_rng(4))
    counted_from_ours = RigidTransform.from_translation([*examples.SCALE_MM, 0.0]).as_matrix()
    tool = poses.as_matrix() @ np.linalg.inv(counted_from_ours) @ np.linalg.inv(examples.TOOL_FROM_IMAGE)
    expected = examples.published_errors(true_tool, tool, published)
    assert min(expected.values()) > 0.01
    row = score_row(poses, true, sweep.grid, marks)
    assert {name: row[name] for name in expected} == pytest.approx(expected, abs=1e-9)
    largest = examples.published_errors(true_tool, np.tile(np.eye(4), (len(true_tool), 1, 1)), published)
    score = np.mean([(expected[key] - largest[key]) / (0.0 - largest[key]) for key in expected])
    assert challenge_score(poses, true, sweep.grid, marks) == pytest.approx(score, abs=1e-9)
    resting = RigidTransform.identity(len(true))
    assert challenge_score(resting, true, sweep.grid, marks) == pytest.approx(0.0)
    with pytest.raises(InsufficientDataError, match="GPE_mm"):
        challenge_score(true, resting, sweep.grid, marks)
