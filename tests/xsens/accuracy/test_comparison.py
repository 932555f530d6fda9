"""Two streams of orientation: known turns are told apart into heading and inclination."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from speckle3d.core.streams import TimedRotations
from xsens.accuracy.angles import compare_orientations

TIME_S = np.arange(0.0, 5.0, 0.05)


def streams(second):
    """A moving sensor, and the same seen through a turn of the world."""
    moving = Rotation.from_euler("ZYX", np.column_stack([TIME_S, 0.4 * np.sin(TIME_S), 0.3 * np.cos(TIME_S)]))
    return TimedRotations(TIME_S, second * moving), TimedRotations(TIME_S, moving)


def test_a_turn_about_up_is_heading_alone():
    turn_rad = np.pi - 0.01
    comparison = compare_orientations(*streams(Rotation.from_rotvec([0.0, 0.0, turn_rad])))
    assert (comparison.heading_rms_rad, comparison.total_rms_rad) == pytest.approx(
        (turn_rad, turn_rad), abs=1e-9
    )
    assert comparison.inclination_rms_rad == pytest.approx(0.0, abs=1e-7)
    assert comparison.heading_rms_without_offset_rad == pytest.approx(0.0, abs=1e-9)
    assert comparison.heading_offset_rad == pytest.approx(turn_rad)
