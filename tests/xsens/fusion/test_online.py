"""The filter fed sample by sample: as over a whole log, whatever the pieces; pauses; missing readings."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import InvalidInputError, MismatchError
from xsens.fusion.online import OnlineFilter
from xsens.fusion.orient import orient
from xsens.logs.samples import ImuLog

RATE_HZ = 100.0


def moving(seconds=20.0, seed=3):
    """A sensor swung about all axes with noise and bias, at rest for the first two seconds, and its truth."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(1, round(seconds * RATE_HZ) + 1) / RATE_HZ
    swing = np.clip(time_s - 2.0, 0.0, None)
    angles = np.column_stack([np.sin(1.3 * swing), 0.5 * np.sin(2.1 * swing), 0.7 * np.sin(1.7 * swing)])
    truth = Rotation.from_euler("ZYX", angles)
    before = Rotation.concatenate([truth[:1], truth[:-1]])
    rate = (before.inv() * truth).as_rotvec() * RATE_HZ + np.deg2rad([0.2, -0.1, 0.3])
    force = truth.inv().apply([0.0, 0.0, 9.80665])
    field = truth.inv().apply([0.5, 0.0, -0.86])
    noisy = [each + sd * rng.standard_normal(each.shape) for each, sd in ((rate, 0.01), (force, 0.05))]
    return truth, ImuLog(time_s, noisy[1], noisy[0], field + 0.01 * rng.standard_normal(field.shape))


def pushed(log, pieces):
    online = OnlineFilter()
    steps = np.concatenate([[1 / RATE_HZ], np.diff(log.time_s)])
    for part in np.array_split(np.arange(len(log)), pieces):
        online.push(
            steps[part],
            log.gyroscope_rad_s[part],
            log.accelerometer_m_s2[part],
            log.magnetometer_au[part],
        )
    return online.state


def apart_deg(one, other):
    return np.rad2deg((one.inv() * other).magnitude())


def test_ends_where_the_filter_over_the_whole_log_ends():
    truth, log = moving()
    whole = orient(log, method="filter")
    state = pushed(log, len(log))
    # The log's filter sums two seconds with one bias and corrects to first order; that is all the difference.
    assert apart_deg(state.world_from_sensor, whole.rotations.world_from_sensor[-1]) < 0.02
    np.testing.assert_allclose(state.standard_deviation_rad, whole.standard_deviation_rad[-1], rtol=0.05)
    assert apart_deg(state.world_from_sensor, truth[-1]) < 1.5
    assert state.started
    assert not state.resting


def test_the_orientation_is_that_of_the_last_sample_between_increments_too():
    # Turning at 1 rad/s about up: 0.57 degrees a sample, while increments are of three samples.
    truth, log = moving(6.0)
    online = OnlineFilter()
    errors = []
    for k in range(len(log)):
        online.push(1 / RATE_HZ, log.gyroscope_rad_s[k], log.accelerometer_m_s2[k], log.magnetometer_au[k])
        if k > 300:
            errors.append((online.state.world_from_sensor * truth[k].inv()).as_rotvec())
    # From sample to sample the error moves by gyroscope noise (0.006 degrees) and corrections alone: a
    # quarter of a second's field shows the heading to about a degree, of which a correction takes a fifth.
    assert np.rad2deg(np.abs(np.diff(errors, axis=0)).max()) < 0.3


def test_after_a_pause_up_is_found_again():
    _, log = moving(4.0)
    online = OnlineFilter()
    turned = Rotation.from_euler("ZYX", [0.0, 0.8, 0.3])
    for k in range(len(log)):
        online.push(1 / RATE_HZ, log.gyroscope_rad_s[k], log.accelerometer_m_s2[k], log.magnetometer_au[k])
    still = [turned.inv().apply(v) for v in ([0.0, 0.0, 9.80665], [0.5, 0.0, -0.86])]
    online.push(3.0, np.zeros(3), *still)
    for _ in range(150):
        online.push(1 / RATE_HZ, np.zeros(3), *still)
    assert apart_deg(online.state.world_from_sensor, turned) < 1.0


def test_missing_readings_are_bridged_and_bad_ones_refused():
    online = OnlineFilter()
    assert online.state is None
    gyroscope = np.zeros((40, 3))
    gyroscope[20:23] = np.nan
    online.push(np.full(40, 0.01), gyroscope, np.tile([0.0, 0.0, 9.8], (40, 1)))
    state = online.state
    assert apart_deg(state.world_from_sensor, Rotation.identity()) < 1e-6
    assert state.standard_deviation_rad[2] > 1.0  # nothing has told the heading
    with pytest.raises(MismatchError, match="gyroscope_rad_s"):
        online.push(0.01, [0.0, 0.0], [0.0, 0.0, 9.8])
    with pytest.raises(InvalidInputError, match="step_s"):
        online.push(0.0, [0.0, 0.0, 0.0], [0.0, 0.0, 9.8])
