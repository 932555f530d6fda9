"""Whether the magnetometer can be trusted: judged in fields whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from broad import read_trial

from xsens.fusion.field import POOR, FieldFound, Trust, field_of
from xsens.fusion.orient import orient

GOOD = FieldFound(np.radians(1.4), 0.02, 0.01, 0.0, np.radians(3.2), 186.0)


def judge(log):
    return field_of(log, orient(log))


def test_each_doubt_counts():
    trusts = {
        Trust.CARE: {"iron": 0.9},
        Trust.NO: {"stray": 1.01 * POOR},
        Trust.UNKNOWN: {"stray": np.nan},
        Trust.YES: {},
    }
    for trust, changes in trusts.items():
        assert replace(GOOD, **changes).trust is trust
    for change in ({"disbelieved": 0.51}, {"heading_sd_rad": np.radians(10.1)}):
        assert replace(GOOD, **change).trust is Trust.NO


@pytest.mark.realdata
def test_a_magnet_on_the_sensor_is_told_in_a_recorded_trial(realdata):
    log, _, _ = read_trial(realdata / "broad", "35_disturbed_attached_magnet_4cm")
    field = judge(log)
    assert field.trust is Trust.CARE
    assert field.iron > 0.5
    log, _, _ = read_trial(realdata / "broad", "05_undisturbed_slow_rotation_with_breaks_B")
    assert judge(log).trust is Trust.YES
