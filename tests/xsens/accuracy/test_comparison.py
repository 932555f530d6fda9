"""Two streams of orientation: known turns are told apart into heading and inclination."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.streams import TimedRotations
from xsens.accuracy.comparison import compare_orientations

TIME_S = np.arange(0.0, 5.0, 0.05)


def streams(turned):
    """A moving sensor, and the same seen through a turn of the world."""
    moving = Rotation.from_euler("ZYX", np.column_stack([TIME_S, 0.4 * np.sin(TIME_S), 0.3 * np.cos(TIME_S)]))
    return TimedRotations(TIME_S, turned * moving), TimedRotations(TIME_S, moving)


@pytest.mark.parametrize("turn_rad", [0.2, np.pi - 0.01])
def test_a_turn_about_up_is_heading_alone(turn_rad):
    found = compare_orientations(*streams(Rotation.from_rotvec([0.0, 0.0, turn_rad])))
    assert (found.heading_rms_rad, found.total_rms_rad) == pytest.approx((turn_rad, turn_rad), abs=1e-9)
    assert found.inclination_rms_rad == pytest.approx(0.0, abs=1e-7)
    assert found.heading_rms_without_offset_rad == pytest.approx(0.0, abs=1e-9)
    assert found.heading_offset_rad == pytest.approx(turn_rad)


def test_the_other_stream_is_interpolated_and_must_overlap():
    one, other = streams(Rotation.identity())
    half = TimedRotations(TIME_S[::2], other.world_from_sensor[::2])
    # Between samples a tenth of a second apart, of up to 1 rad/s^2: 0.1**2 / 8.
    assert compare_orientations(one, half).total_rms_rad < 1.25e-3
    with pytest.raises(InsufficientDataError):
        compare_orientations(one, TimedRotations(TIME_S + 100.0, other.world_from_sensor))
