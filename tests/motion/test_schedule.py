"""Which frames are measured against which."""

import numpy as np

from speckle3d.motion.schedule import PairSchedule, TrajectorySettings

SIGMA_MM = 0.45


def test_key_frames_are_farther_apart_where_the_probe_is_slow():
    settings = TrajectorySettings(recent=2, key_frames=3, key_correlation=0.9)
    schedule = PairSchedule(settings)
    z = np.concatenate([np.linspace(0, 0.3, 31), 0.3 + 0.1 * np.arange(1, 31)])
    keys = [0]
    for frame in range(len(z)):
        references = schedule.references(frame)
        assert references == sorted(set(references), reverse=True)
        assert all(r < frame for r in references)
        assert len(references) <= 12  # however long the sweep
        rho = {r: float(np.exp(-((z[frame] - z[r]) ** 2) / (2 * SIGMA_MM**2))) for r in references}
        schedule.settle(frame, rho)
        if frame and frame in schedule.needed(frame + 10):
            keys.append(frame)
        assert set(schedule.references(frame + 1)) <= schedule.needed(frame)
    apart = np.diff(z[keys])
    # Correlation 0.9 is 0.207 mm: the first frame past it, a step of 0.01 or 0.1 mm later at most.
    assert (apart >= 0.2).all()
    assert (apart <= 0.31).all()
