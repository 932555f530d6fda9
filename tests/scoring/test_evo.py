"""Metrics against evo's, on the same trajectories, handed over as TUM text."""

import numpy as np
import pytest
from drifting import drifted, hand_sweep

from speckle3d.io.tum import write_tum
from speckle3d.scoring.displacements import drift_rates, point_errors

metrics = pytest.importorskip("evo.core.metrics", reason="evo is not installed")
file_interface = pytest.importorskip("evo.tools.file_interface", reason="evo is not installed")

ORIGIN_MM = np.zeros(3)


@pytest.fixture(scope="module")
def trajectories(tmp_path_factory):
    rng = np.random.default_rng(7)
    truth = hand_sweep(rng, 40)
    pair = [poses[0].inv() * poses for poses in (truth, drifted(truth, rng))]
    folder = tmp_path_factory.mktemp("evo")
    for name, poses in zip("te", pair, strict=True):
        write_tum(folder / name, np.arange(40) / 30.0, poses, "mm")
    return pair, tuple(file_interface.read_tum_trajectory_file(str(folder / name)) for name in "te")


def of_evo(metric, trajectories):
    metric.process_data(trajectories)
    return np.asarray(metric.error)


def test_drift_of_the_origin_is_the_absolute_pose_error(trajectories):
    (truth, estimate), texts = trajectories
    ours = drift_rates(estimate, truth, ORIGIN_MM)
    shift = of_evo(metrics.APE(metrics.PoseRelation.translation_part), texts)
    angle = of_evo(metrics.APE(metrics.PoseRelation.rotation_angle_deg), texts)
    path = texts[0].distances
    assert ours.maximum_drift_mm == pytest.approx(shift.max(), abs=1e-9)
    assert ours.sum_of_drift_mm == pytest.approx(shift.sum(), abs=1e-9)
    assert ours.final_drift_rate == pytest.approx(shift[-1] / path[-1], abs=1e-9)
    assert ours.mean_angle_deg == pytest.approx(angle[1:].mean(), abs=1e-9)


def test_point_errors_of_the_origin_are_absolute_and_relative_pose_errors(trajectories):
    (truth, estimate), texts = trajectories
    ours = point_errors(estimate, truth, ORIGIN_MM[None])
    whole = of_evo(metrics.APE(metrics.PoseRelation.translation_part), texts)
    local = of_evo(metrics.RPE(metrics.PoseRelation.point_distance, 1, metrics.Unit.frames), texts)
    steps = of_evo(metrics.RPE(metrics.PoseRelation.translation_part, 1, metrics.Unit.frames), texts)
    assert ours.global_mm == pytest.approx(whole[1:].mean(), abs=1e-9)
    # evo's error is that of E = true_step^-1 * step, whose translation is as long as the steps' difference.
    assert ours.local_mm == pytest.approx(steps.mean(), abs=1e-9)
    assert (local <= steps + 1e-9).all()
