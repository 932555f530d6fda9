import numpy as np
import pytest
from drifting import CENTRE_MM, CORNERS_MM, drifted, hand_sweep
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.study.points import drift_rates, point_errors


def sliding(length_mm, frames=51):
    return RigidTransform.from_translation(np.outer(np.linspace(0.0, length_mm, frames), [0.0, 0.0, 1.0]))


def test_a_uniform_stretch_of_a_straight_sweep():
    rates = drift_rates(sliding(105.0), sliding(100.0), CENTRE_MM)
    assert rates.final_drift_rate == pytest.approx(0.05)
    assert rates.average_drift_rate == pytest.approx(0.05)
    assert rates.maximum_drift_mm == pytest.approx(5.0)
    assert rates.sum_of_drift_mm == pytest.approx(5.0 * 51 / 2)
    assert rates.mean_angle_deg == pytest.approx(0.0, abs=1e-9)
    errors = point_errors(sliding(105.0), sliding(100.0), CORNERS_MM)
    assert errors.global_mm == pytest.approx(5.0 * 51 / 100)
    assert errors.local_mm == pytest.approx(0.1)


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
