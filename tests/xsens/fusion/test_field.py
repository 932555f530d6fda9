"""Whether the magnetometer can be trusted: judged in fields whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from broad import read_trial

from xsens.fusion.field import POOR, FieldFound, Trust, field_of
from xsens.fusion.orient import orient

GOOD = FieldFound(np.radians(1.4), 0.02, 0.01, 0.0, np.radians(3.2), 186.0)


def judged(log):
    return field_of(log, orient(log))


@pytest.mark.parametrize(
    ("changes", "trust"),
    [
        ({}, Trust.YES),
        ({"iron": 0.9}, Trust.CARE),
        ({"stray": 1.01 * POOR}, Trust.NO),
        ({"disbelieved": 0.51}, Trust.NO),
        ({"heading_sd_rad": np.radians(10.1)}, Trust.NO),
        ({"stray": np.nan}, Trust.UNKNOWN),
    ],
)
def test_each_doubt_counts_and_is_said(changes, trust):
    found = replace(GOOD, **changes)
    assert found.trust is trust
    assert trust.value in found.sentence()


@pytest.mark.realdata
def test_a_magnet_on_the_sensor_is_told_in_a_recorded_trial(realdata):
    log, _, _ = read_trial(realdata / "broad", "35_disturbed_attached_magnet_4cm")
    found = judged(log)
    assert found.trust is Trust.CARE
    assert found.iron > 0.5
    log, _, _ = read_trial(realdata / "broad", "05_undisturbed_slow_rotation_with_breaks_B")
    assert judged(log).trust is Trust.YES
