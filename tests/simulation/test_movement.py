"""Hand-like trajectories: their limits, their smoothness, the world they live in."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from speckle3d.core.geometry import relative_poses, roll_yaw_tilt
from speckle3d.simulation.movement import hand_sweep
from speckle3d.simulation.settings import SimulationSettings


def sweep(seed, duration_s=6.4, **changes):
    rng = np.random.default_rng(seed)
    return hand_sweep(SimulationSettings(**changes), duration_s, 37.8, RigidTransform.identity(), rng)


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_sweep_stays_within_what_a_hand_does(seed):
    poses = sweep(seed).medium_from_image(np.arange(160) / 25.0)
    steps = relative_poses(poses)
    # Speed at most doubles from unevenness and catching up after a pause; tremor adds a few times 0.02 mm.
    assert np.abs(steps.translation[:, 2]).max() < 0.4
    # Bounded by construction: twelve sinusoids of rms one never exceed sqrt(24).
    pivot = poses.apply([18.9, 0.0, 0.0])
    assert np.abs(pivot[:, :2] - [18.9, 0.0]).max() < np.sqrt(24) * (0.5 + 0.012) + 0.01
    assert np.rad2deg(np.abs(roll_yaw_tilt(poses.rotation))).max() < np.sqrt(24) * 0.62
    assert pivot[-1, 2] - pivot[0, 2] == pytest.approx(20.0, abs=0.3)


def test_a_reversal_comes_back():
    z = sweep(3, 12.8, preset="reversal").medium_from_image(np.arange(320) / 25.0).apply([18.9, 0, 0])[:, 2]
    assert z.max() == pytest.approx(20.0, abs=0.2)
    assert z[[0, -1]] == pytest.approx([0.0, 0.0], abs=0.3)
    assert 120 < z.argmax() < 200
