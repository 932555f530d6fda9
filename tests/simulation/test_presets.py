"""Presets: from settings to whole sweeps."""

import numpy as np
import pytest

from speckle3d.core.geometry import roll_yaw_tilt
from speckle3d.simulation.presets import SimulationSettings, simulate
from speckle3d.simulation.receiver import received


def small(preset, **changes):
    return SimulationSettings(preset=preset, **{"seed": 3, "vectors": 4, "samples": 600, **changes})


@pytest.mark.parametrize("preset", ["reversal", "crossed", "stepped"])
def test_every_preset_makes_sweeps_with_truth_and_seed(preset):
    sweeps = simulate(small(preset))
    assert len(sweeps) == (2 if preset == "crossed" else 1)
    for item in sweeps:
        sweep = item.sweep
        assert sweep.truth is not None
        assert item.settings.seed == 3
        frame = sweep.frames[len(sweep) // 2]
        assert frame.shape == (4, 600)
        assert frame.std() > 30
        if preset != "stepped":
            assert sweep.tracker.covers(sweep.frame_time_s).all()
            assert sweep.orientation.covers(sweep.frame_time_s).all()


def test_the_same_seed_gives_the_same_sweep_and_another_another():
    a, b, c = (simulate(small("tissue", seed=s))[0].sweep for s in (5, 5, 6))
    np.testing.assert_array_equal(a.frames[7], b.frames[7])
    np.testing.assert_array_equal(a.truth.as_matrix(), b.truth.as_matrix())
    np.testing.assert_array_equal(a.orientation.accelerometer_m_s2, b.orientation.accelerometer_m_s2)
    assert not np.array_equal(a.frames[7], c.frames[7])
    assert not np.allclose(a.truth.as_matrix(), c.truth.as_matrix())


def test_a_rotation_turns_by_its_setting():
    with_turn, without = (
        simulate(small("rotation", turn_deg=t, turn_axis="yaw"))[0].sweep.truth.rotation for t in (6.0, 0.0)
    )
    turn, plain = (roll_yaw_tilt(r[0].inv() * r[-1]) for r in (with_turn, without))
    assert np.rad2deg(turn - plain)[1] == pytest.approx(6.0, abs=0.1)


@pytest.mark.parametrize(("kind", "range_db"), [("iq", None), ("bmode", 60.0)])
def test_sweeps_are_stored_as_i_and_q_or_as_grey_levels_where_asked_for(kind, range_db):
    rf, sweep = (simulate(small("phantom", frames=3, signal=signal))[0].sweep for signal in ("rf", kind))
    expected = received(rf, range_db)
    np.testing.assert_array_equal(sweep.frames[1], expected.frames[1])
    assert (sweep.grid, sweep.signal) == (expected.grid, expected.signal)


def test_raises_on_a_sector_of_parallel_vectors():
    with pytest.raises(ValueError, match="sector_deg"):
        SimulationSettings(sector_deg=30.0)
    assert SimulationSettings(array="phased", sector_deg=30.0).sector_deg == 30.0
