"""Heading by the magnetic field, in cases whose answer is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xsens.fusion.orient import orient
from xsens.logs.samples import ImuLog

RATE_HZ = 50.0
EARTH = np.array([18.0, 0.0, -45.0])


def attitude(time_s):
    """A sensor that is turned about all axes."""
    angles = np.column_stack([np.sin(1.3 * time_s), 0.9 * np.sin(0.7 * time_s), np.sin(1.1 * time_s)])
    return Rotation.from_euler("ZYX", 1.2 * angles)


def turned(seconds=60.0, seed=8, lag_s=0.0, iron=(0.0, 0.0, 0.0)):
    """A log of a sensor that is turned, and its truth."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(1, round(seconds * RATE_HZ) + 1) / RATE_HZ
    truth = attitude(time_s)
    rate = (attitude(time_s - 1.0 / RATE_HZ).inv() * truth).as_rotvec() * RATE_HZ
    rate = rate + [0.004, -0.003, 0.005] + 0.003 * rng.standard_normal(rate.shape)
    force = truth.inv().apply([0.0, 0.0, 9.80665]) + 0.2 * rng.standard_normal(rate.shape)
    field = attitude(time_s - lag_s).inv().apply(EARTH) + iron + 0.3 * rng.standard_normal(rate.shape)
    return ImuLog(time_s, force, rate, field), truth


def heading_deg(found, truth):
    return np.rad2deg(np.abs((found.rotations.world_from_sensor * truth.inv()).as_rotvec()[:, 2]))


@pytest.mark.parametrize(("method", "after", "most_deg"), [("smoother", 0, 0.5), ("filter", 2000, 1.1)])
def test_iron_on_the_sensor_from_the_start_is_found_by_turning_it(method, after, most_deg):
    # A third of the field's norm, more than half of its horizontal part.
    log, truth = turned(iron=[12.0, -9.0, 5.0])
    found = orient(log, method=method)
    assert heading_deg(found, truth)[after:].max() < most_deg
    assert found.field_iron[-1] > 0.9


@pytest.mark.parametrize(("method", "most_deg"), [("smoother", 0.35), ("filter", 1.5)])
def test_a_late_magnetometer_costs_little(method, most_deg):
    log, truth = turned(lag_s=0.02)  # half a degree per 0.4 rad/s
    assert heading_deg(orient(log, method=method), truth)[500:].max() < most_deg
