"""Which frames are measured against which."""

import numpy as np

from speckle3d.matching.schedule import PairSchedule, TrajectorySettings

SIGMA_MM = 0.45


def test_key_frames_are_farther_apart_where_the_probe_is_slow():
    settings = TrajectorySettings(recent=2, key_frames=3, key_correlation=0.9)
    schedule = PairSchedule(settings)
    z = np.concatenate([np.linspace(0, 0.3, 31), 0.3 + 0.1 * np.arange(1, 31)])
    keys = set()
    for frame in range(len(z)):
        references = schedule.references(frame)
        assert references == sorted(set(references), reverse=True)
        keys |= {reference for reference in references if reference < frame - settings.recent}
        assert all(r < frame for r in references)
        assert len(references) <= 12  # however long the sweep
        rho = {r: float(np.exp(-((z[frame] - z[r]) ** 2) / (2 * SIGMA_MM**2))) for r in references}
        schedule.settle(frame, rho)
        assert set(schedule.references(frame + 1)) <= schedule.needed(frame)
    apart = np.diff(z[sorted(keys)])
    # Correlation 0.9 is 0.207 mm: the first frame past it, a step of 0.01 or 0.1 mm later at most.
    assert (apart >= 0.2).all()
    assert (apart <= 0.31).all()


def test_frames_before_a_lifted_probe_are_kept_until_it_is_back():
    schedule = PairSchedule(TrajectorySettings(recent=2, key_frames=3))
    for frame in range(10):
        schedule.settle(frame, dict.fromkeys(schedule.references(frame), 0.95))
    for frame in range(10, 30):
        assert schedule.references(frame)[0] == 9
        schedule.settle(frame, dict.fromkeys(schedule.references(frame), 0.05))
        assert {8, 9} <= schedule.needed(frame)
    assert schedule.references(30) == [9, 29, 28, 8, 0]
    schedule.settle(30, {9: 0.6, 29: 0.05, 28: 0.05, 8: 0.5})
    assert schedule.references(31)[0] == 30
