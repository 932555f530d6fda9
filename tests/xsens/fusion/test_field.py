"""Whether the magnetometer can be trusted: judged in fields whose truth is known."""

import pytest
from broad import read_trial

from xsens.fusion.field import Trust, field_of
from xsens.fusion.orient import orient


def judge(log):
    return field_of(log, orient(log))


@pytest.mark.realdata
def test_a_magnet_on_the_sensor_is_told_in_a_recorded_trial(realdata):
    log, _, _ = read_trial(realdata / "broad", "35_disturbed_attached_magnet_4cm")
    field = judge(log)
    assert field.trust is Trust.CARE
    assert field.iron > 0.5
    log, _, _ = read_trial(realdata / "broad", "05_undisturbed_slow_rotation_with_breaks_B")
    assert judge(log).trust is Trust.YES
