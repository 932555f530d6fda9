import numpy as np
import pytest
from drifting import CENTRE_MM, CORNERS_MM, drifted, hand_sweep
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.sweep import ImageGrid
from speckle3d.scoring.displacements import drift_rates, landmark_errors, pixel_errors, point_errors


def sliding(length_mm, frames=51):
    return RigidTransform.from_translation(np.outer(np.linspace(0.0, length_mm, frames), [0.0, 0.0, 1.0]))


def test_a_uniform_stretch_of_a_straight_sweep():
    rates = drift_rates(sliding(105.0), sliding(100.0), CENTRE_MM)
    assert rates.final_drift_rate == pytest.approx(0.05)
    assert rates.average_drift_rate == pytest.approx(0.05)
    assert rates.maximum_drift_mm == pytest.approx(5.0)
    assert rates.sum_of_drift_mm == pytest.approx(5.0 * 51 / 2)
    # The estimate's last centre, 5 mm past the reference's last.
    assert rates.hausdorff_mm == pytest.approx(5.0)
    assert rates.mean_angle_deg == pytest.approx(0.0, abs=1e-9)
    errors = point_errors(sliding(105.0), sliding(100.0), CORNERS_MM)
    assert errors.global_mm == pytest.approx(5.0 * 51 / 100)
    assert errors.local_mm == pytest.approx(0.1)
    assert pixel_errors(sliding(105.0), sliding(100.0), ImageGrid(4, 5, 0.3, 0.2)) == errors_like(errors)


def errors_like(errors):
    """The same errors, up to rounding."""
    return type(errors)(pytest.approx(errors.global_mm), pytest.approx(errors.local_mm))


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
    assert errors == errors_like(point_errors(estimate, truth, pixels))


def test_pixels_and_landmarks_of_a_known_turn():
    """Frame 1 is turned by 90 degrees about z and stays so; by hand, p moves by sqrt(2) of its distance."""
    turned = RigidTransform.from_rotation(Rotation.from_euler("z", [[0.0], [90.0], [90.0]], degrees=True))
    still = RigidTransform.identity(3)
    # Frame 2 sits on frame 1, so that its step is right and its place is not.
    marks = landmark_errors(turned, still, [1, 2], [[3.0, 4.0, 0.0], [0.0, 10.0, 0.0]])
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
    assert drift_rates(at(0.0, 2.0, 7.0), at(0.0, 1.0, 4.0), np.zeros(3)).hausdorff_mm == pytest.approx(3.0)
    assert drift_rates(at(0.0, 1.0, 4.0), at(0.0, 2.0, 7.0), np.zeros(3)).hausdorff_mm == pytest.approx(3.0)
    # The same places in another order: each centre drifts, and none is far from the other set.
    back = drift_rates(at(0.0, 4.0, 1.0), at(0.0, 1.0, 4.0), np.zeros(3))
    assert (back.hausdorff_mm, back.maximum_drift_mm) == pytest.approx((0.0, 3.0))


def test_rates_are_of_the_path_travelled_not_of_the_way_gained():
    def at(*z):
        return RigidTransform.from_translation([[0.0, 0.0, value] for value in z])

    # There and back: the path is 1, then 2 mm long; drifts are 0.1 and 0.3 mm.
    rates = drift_rates(at(0.0, 1.1, 0.3), at(0.0, 1.0, 0.0), CENTRE_MM)
    assert rates.final_drift_rate == pytest.approx(0.3 / 2)
    assert rates.average_drift_rate == pytest.approx((0.1 / 1 + 0.3 / 2) / 2)
    assert (rates.maximum_drift_mm, rates.sum_of_drift_mm) == pytest.approx((0.3, 0.4))


def test_the_error_of_angle_is_about_one_axis_whichever():
    """Turns about two axes: the angle is of the whole turn, neither a sum nor a mean of components."""
    turn = Rotation.from_rotvec(np.deg2rad([[0.0, 0, 0], [3.0, 4.0, 0.0], [0.0, 0.0, -1.0]]))
    rates = drift_rates(sliding(2.0, 3) * RigidTransform.from_rotation(turn), sliding(2.0, 3), np.zeros(3))
    assert rates.mean_angle_deg == pytest.approx((5.0 + 1.0) / 2)


@pytest.mark.parametrize(
    ("frames", "points", "message"),
    [
        ([], np.empty((0, 3)), "a point per frame"),
        ([1], [[0.0, 0.0]], "a point per frame"),
        ([1, 0], np.zeros((2, 3)), "landmark 1: expected a frame from 1 to 50, got 0"),
        ([51], np.zeros((1, 3)), "landmark 0: expected a frame from 1 to 50, got 51"),
    ],
)
def test_a_landmark_that_has_no_error_is_refused(frames, points, message):
    with pytest.raises(InvalidInputError, match=message):
        landmark_errors(sliding(1.0), sliding(1.0), frames, points)


def test_a_constant_angle_between_frames_adds_up_to_its_mean():
    turned = RigidTransform.from_rotation(Rotation.from_rotvec(np.outer(np.arange(51), [0.01, 0, 0])))
    rates = drift_rates(sliding(100.0) * turned, sliding(100.0), np.zeros(3))
    assert rates.mean_angle_deg == pytest.approx(np.rad2deg(0.01) * 51 / 2)
    assert rates.maximum_drift_mm == pytest.approx(0.0, abs=1e-9)


def test_neither_world_matters():
    rng = np.random.default_rng(1)
    truth = hand_sweep(rng, 40)
    estimate = drifted(truth, rng)
    world = RigidTransform.from_components([9.0, -80.0, 3.0], Rotation.random(rng=rng))
    here, there = point_errors(estimate, truth, CORNERS_MM), point_errors(world * estimate, truth, CORNERS_MM)
    assert (here.global_mm, here.local_mm) == pytest.approx((there.global_mm, there.local_mm))
    assert here.global_mm > 0.5


def test_a_rest_at_the_start_is_left_out_of_the_average_rate():
    still = RigidTransform.concatenate([sliding(100.0)[:1], sliding(100.0)])
    stretched = RigidTransform.concatenate([sliding(105.0)[:1], sliding(105.0)])
    assert drift_rates(stretched, still, CENTRE_MM).average_drift_rate == pytest.approx(0.05)


def test_a_reference_at_rest_or_of_another_length_is_refused():
    with pytest.raises(InsufficientDataError, match="a reference that moves"):
        drift_rates(sliding(1.0), RigidTransform.identity(51), CENTRE_MM)
    with pytest.raises(MismatchError, match="reference: expected 51 poses, got 50"):
        point_errors(sliding(1.0), sliding(1.0)[1:], CORNERS_MM)
