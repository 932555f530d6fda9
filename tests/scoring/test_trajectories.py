"""Pose errors against evo's on the same files, and trajectories of different kinds against each other."""

import numpy as np
import pytest
import sweep_examples
from drifting import drifting_poses, hand_sweep
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.reconstruction import Provenance, Reconstruction
from speckle3d.io.family.reconstructions import write_reconstruction
from speckle3d.io.family.sweep_writer import write_sweep
from speckle3d.io.tum import write_tum
from speckle3d.scoring.displacements import score_row
from speckle3d.scoring.trajectories import (
    Trajectory,
    compare_trajectories,
    load_estimate,
    load_reference,
)


@pytest.fixture(scope="module")
def pair():
    rng = np.random.default_rng(7)
    truth = hand_sweep(rng, 40)
    return drifting_poses(truth, rng), truth


@pytest.fixture(scope="module")
def texts(pair, tmp_path_factory):
    folder = tmp_path_factory.mktemp("texts")
    for name, poses in zip(("estimate.tum", "reference.tum"), pair, strict=True):
        write_tum(folder / name, np.arange(40) / 30.0, poses)
    return folder / "estimate.tum", folder / "reference.tum"


@pytest.mark.slow
def test_pose_errors_are_evos(texts):
    metrics = pytest.importorskip("evo.core.metrics")
    files = pytest.importorskip("evo.tools.file_interface")
    estimate, true = (files.read_tum_trajectory_file(str(path)) for path in texts)
    estimate.align_origin(true)
    ours = compare_trajectories(load_estimate(texts[0]), load_reference(texts[1]))
    for name, metric, extra in (("APE", metrics.APE, ()), ("RPE", metrics.RPE, (1, metrics.Unit.frames))):
        for relation, scale, unit in (("translation_part", 1000.0, "mm"), ("rotation_angle_deg", 1.0, "deg")):
            error = metric(metrics.PoseRelation[relation], *extra)
            error.process_data((true, estimate))
            for statistic in ("rmse", "mean", "max"):
                expected = scale * error.get_statistic(metrics.StatisticsType[statistic])
                # Of 20 mm, printed in metres and back.
                assert getattr(ours[name], f"{statistic}_{unit}") == pytest.approx(expected, abs=1e-9)
                assert expected > 1e-3


def test_a_reconstruction_is_scored_against_a_sweep(tmp_path):
    sweep = sweep_examples.rf_sweep()
    write_sweep(tmp_path / "s.h5", sweep)
    rng = np.random.default_rng(2)
    poses = {"image": drifting_poses(sweep.truth, rng), "pose": sweep.truth}
    provenance = Provenance("s.h5", "ab", "0.1.0")
    write_reconstruction(tmp_path / "r.h5", Reconstruction(sweep.frame_time_s, sweep.grid, poses, provenance))
    reference = load_reference(tmp_path / "s.h5")
    scores = compare_trajectories(load_estimate(tmp_path / "r.h5"), reference)
    expected = score_row(poses["image"], sweep.truth, sweep.grid)
    assert {key: scores[key] for key in expected if expected[key] is not None} == pytest.approx(
        {key: value for key, value in expected.items() if value is not None}, abs=1e-9
    )
    # Its provenance names other bytes.
    assert scores["same_sweep"] is False
    with pytest.raises(InvalidInputError):
        load_estimate(tmp_path / "r.h5", "orientation")


def test_poses_meet_by_time_and_those_without_a_reference_are_left_out():
    z = np.linspace(0.0, 10.0, 101)
    times = np.linspace(0.0, 1.0, 101)
    line = RigidTransform.from_translation(np.column_stack([0 * z, 0 * z, z]))
    # Every 0.01 s against readings every 0.04 s that begin later and end earlier.
    reference = Trajectory("r", times[10:91:4], line[10:91:4])
    scores = compare_trajectories(Trajectory("e", times, line), reference)
    assert (scores["poses"], scores["left_out"]) == (81, 20)
    assert scores["APE"].max_mm == pytest.approx(0.0, abs=1e-9)
