"""The challenge's errors and scores against its published definition, computed from displacement fields."""

import challenge_examples as examples
import numpy as np
import pytest
from drifting import drifted
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.io.load import load_landmarks, load_sweep
from speckle3d.scoring.scores import challenge_errors, challenge_score, drift_rows, scores_among
from speckle3d.study.job import find_reference


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
    (row,) = drift_rows(sweep, {"image": poses}, find_reference(sweep, None), load_landmarks(path))
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
    with pytest.raises(InsufficientDataError, match="GPE_mm: expected a worst and a best that differ"):
        challenge_score(true, RigidTransform.identity(len(true)), sweep.grid, marked)


def test_scores_among_methods_run_from_the_worst_to_the_best():
    names = ("GPE_mm", "GLE_mm", "LPE_mm", "LLE_mm")
    errors = {
        "good": dict(zip(names, (2.0, 3.0, 0.2, 0.5), strict=True)),
        "fair": dict(zip(names, (4.0, 9.0, 0.1, 0.5), strict=True)),
        "poor": dict(zip(names, (6.0, 7.0, 0.3, 0.9), strict=True)),
    }
    # By hand: (1 + 1 + 1/2 + 1)/4, (1/2 + 0 + 1 + 1)/4, (0 + 1/3 + 0 + 0)/4.
    assert scores_among(errors) == pytest.approx({"good": 3.5 / 4, "fair": 2.5 / 4, "poor": 1 / 12})
    with pytest.raises(InsufficientDataError, match="GPE_mm"):
        scores_among({"one": errors["good"]})
    with pytest.raises(InvalidInputError, match="GLE_mm: expected a number, got none"):
        scores_among({"one": errors["good"], "two": errors["fair"] | {"GLE_mm": None}})


def test_without_landmarks_there_are_no_errors_at_landmarks(scan, estimate):
    sweep = load_sweep(scan[0])
    found = challenge_errors(estimate[0], find_reference(sweep, None).world_from_image, sweep.grid)
    assert (found["GLE_mm"], found["LLE_mm"]) == (None, None)
