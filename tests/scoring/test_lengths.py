"""Lengths, turns and their errors by hand, and against a tracker with jitter."""

import numpy as np
import pytest
from drifting import CENTRE_MM, accumulate, drifting_poses, hand_sweep, tracker_poses
from scipy.spatial.transform import RigidTransform

from speckle3d.core.geometry import rotation_from_fixed_angles
from speckle3d.scoring.lengths import compare_modes, monotone_parts, sum_motion


def straight(length_mm, tilt_rad=0.0):
    """Poses whose centre travels along its own z, each frame tilted against the one before."""
    tilts = np.broadcast_to(tilt_rad, len(length_mm) - 1)
    shifts = CENTRE_MM + np.outer(np.diff(length_mm), [0.0, 0.0, 1.0])
    moves = RigidTransform.from_components(shifts, rotation_from_fixed_angles(0.0, 0.0, tilts))
    return accumulate(moves * RigidTransform.from_translation(-CENTRE_MM))


def test_parts_of_a_jittery_tracker_are_those_of_the_hand():
    for seed in range(10):
        rng, turns = np.random.default_rng(seed), 2 * (seed % 2)
        truth = hand_sweep(rng, 300, turns=turns)
        exact = monotone_parts(sum_motion(truth, CENTRE_MM).length_mm)
        rough = monotone_parts(sum_motion(tracker_poses(truth, rng, outliers=0.05), CENTRE_MM).length_mm)
        assert [p.name for p in exact] == [p.name for p in rough] == ["f", "r", "f2"][: turns + 1]
        # Noise of 0.15 / sqrt(9) mm against steps of 0.2 mm per frame, and the width of the mean.
        np.testing.assert_allclose([p.last for p in rough], [p.last for p in exact], atol=5)


@pytest.mark.parametrize("end_frames", [1, 25])
def test_a_uniform_stretch_and_tilt_are_exact_in_every_part(end_frames):
    length = 10.0 - np.abs(np.linspace(-10.0, 10.0, 101))
    image = straight(1.15 * length, np.deg2rad(0.02))
    rows = compare_modes({"image": image}, straight(length), CENTRE_MM, end_frames=end_frames)
    assert [(row.part, row.frames) for row in rows] == [("f", 51), ("r", 51)]
    for row in rows:
        assert (row.reference_mm, row.estimate_mm) == pytest.approx((10.0, 11.5), abs=1e-6)
        assert (row.length_error_mm, row.length_error_percent) == pytest.approx((1.5, 15.0), abs=1e-5)
        assert (row.tilt_error_deg, row.yaw_error_deg) == pytest.approx((1.0, 0.0), abs=1e-6)


def test_a_jittery_tracker_scores_as_the_truth_does_and_says_how_sure_it_is():
    gaps, ratios = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        truth = hand_sweep(rng, 200)
        modes, tracker = {"image": drifting_poses(truth, rng)}, tracker_poses(truth, rng, outliers=0.02)
        (exact,) = compare_modes(modes, truth, CENTRE_MM, end_frames=1)
        (rough,) = compare_modes(modes, tracker, CENTRE_MM)
        gaps.append(rough.length_error_mm - exact.length_error_mm)
        ratios.append((rough.reference_mm - exact.reference_mm) / rough.reference_sigma_mm)
    # Measured on 60 seeds: 0.11 mm with lines through a tenth of the sweep.
    assert np.sqrt(np.mean(np.square(gaps))) < 0.15
    # The claim is of jitter alone; an uneven hand bends the lines a little more.
    assert 0.8 < np.sqrt(np.mean(np.square(ratios))) < 1.8


def test_a_small_retreat_is_no_reversal():
    forward = np.linspace(0, 5, 50)
    for back_mm, names in ((0.4, ["f"]), (0.9, ["f", "r", "f2"])):
        length = np.concatenate([forward, np.linspace(5, 5 - back_mm, 20), forward[1:] + 4.5])
        assert [p.name for p in monotone_parts(length)] == names
