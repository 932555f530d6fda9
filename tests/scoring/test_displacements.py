"""Displacement errors by hand, by brute force, by evo and by TUS-REC's published definition."""

import challenge_examples as examples
import numpy as np
import pytest
from drifting import drifting_poses
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.io.formats.challenge import Landmarks
from speckle3d.io.load import load_landmarks, load_sweep
from speckle3d.scoring.displacements import challenge_score, point_errors, score_row
from speckle3d.scoring.references import find_reference


def sliding(length_mm, frames=51):
    return RigidTransform.from_translation(np.outer(np.linspace(0.0, length_mm, frames), [0.0, 0.0, 1.0]))


def at(*z):
    return RigidTransform.from_translation([[0.0, 0.0, value] for value in z])


def test_drift_by_hand():
    # There and back: the path is 1, then 2 mm long; drifts are 0.1 and 0.3 mm.
    rates = score_row(at(0.0, 1.1, 0.3), at(0.0, 1.0, 0.0), None)
    assert rates["FDR_percent"] == pytest.approx(100 * 0.3 / 2)
    assert rates["ADR_percent"] == pytest.approx(100 * (0.1 / 1 + 0.3 / 2) / 2)
    assert (rates["MD_mm"], rates["SD_mm"]) == pytest.approx((0.3, 0.4))
    # 7 is 3 from the nearest of 0, 1, 4; of these, 4 is 2 from 2, the nearest other.
    assert score_row(at(0.0, 1.0, 4.0), at(0.0, 2.0, 7.0), None)["HD_mm"] == pytest.approx(3.0)
    # Turns about two axes: the angle is of the whole turn, neither a sum nor a mean of components.
    turn = Rotation.from_rotvec(np.deg2rad([[0.0, 0, 0], [3.0, 4.0, 0.0], [0.0, 0.0, -1.0]]))
    rates = score_row(sliding(2.0, 3) * RigidTransform.from_rotation(turn), sliding(2.0, 3), None)
    assert rates["EA_deg"] == pytest.approx((5.0 + 1.0) / 2)
    # A rest at the start is left out of the average rate.
    paths = [RigidTransform.concatenate([sliding(x)[:1], sliding(x)]) for x in (105.0, 100.0)]
    assert score_row(*paths, None)["ADR_percent"] == pytest.approx(5.0)


def test_errors_and_score_are_those_the_challenge_publishes(tmp_path):
    path, _, true_tool, landmarks = examples.write_data_set(tmp_path)
    sweep, marks = load_sweep(path), load_landmarks(path)
    true = find_reference(sweep, None).world_from_image
    poses = drifting_poses(true, np.random.default_rng(4))
    counted_from_ours = RigidTransform.from_translation([*examples.SCALE_MM, 0.0]).as_matrix()
    tool = poses.as_matrix() @ np.linalg.inv(counted_from_ours) @ np.linalg.inv(examples.TOOL_FROM_IMAGE)
    expected = examples.published_errors(true_tool, tool, landmarks)
    assert min(expected.values()) > 0.01
    row = score_row(poses, true, sweep.grid, marks)
    assert {name: row[name] for name in expected} == pytest.approx(expected, abs=1e-9)
    largest = examples.published_errors(true_tool, np.tile(np.eye(4), (len(true_tool), 1, 1)), landmarks)
    score = np.mean([(expected[key] - largest[key]) / (0.0 - largest[key]) for key in expected])
    assert challenge_score(row, true, sweep.grid, marks) == pytest.approx(score, abs=1e-9)


def test_errors_need_a_path_and_frames_of_landmarks():
    with pytest.raises(InvalidInputError):
        point_errors(sliding(1.0), sliding(1.0), None, Landmarks(np.array([51]), np.zeros((1, 3))))
    with pytest.raises(InsufficientDataError):
        score_row(sliding(1.0), RigidTransform.identity(51), None)
    with pytest.raises(MismatchError):
        score_row(sliding(1.0), sliding(1.0)[1:], None)
