"""Orientation from gyroscope, accelerometer and magnetometer: exact cases, disturbances, bad readings."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import InvalidInputError
from xsens.fusion.orient import orient
from xsens.fusion.settings import FusionSettings
from xsens.logs.samples import ImuLog

RATE_HZ = 100.0
FIELD = np.array([0.5, 0.0, -0.86])


def static(seconds, seed=0, field=None):
    """A sensor at rest: white noise, bias that flickers and drifts with temperature, quantised readings."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, seconds, 1 / RATE_HZ)
    turn = Rotation.from_euler("ZYX", [0.7, 0.2, -0.3])
    octaves = [
        np.interp(time_s, np.arange(0, seconds + p, p), rng.standard_normal(int(np.ceil(seconds / p)) + 1))
        for p in (5.0, 20.0, 80.0, 320.0)
    ]
    flicker = np.deg2rad(0.004) * np.sum(octaves, axis=0)
    warming = np.deg2rad(0.02) * (1.0 - np.exp(-time_s / 200.0))
    bias = np.deg2rad([0.3, -0.2, 0.25]) + np.column_stack(
        [flicker + warming, flicker[::-1], flicker - warming]
    )
    gyroscope = bias + np.deg2rad(0.05) * np.sqrt(RATE_HZ) * rng.standard_normal((time_s.size, 3)) * 0.2
    step = np.deg2rad(0.015)
    gyroscope = np.round(gyroscope / step) * step
    force = turn.inv().apply([0.0, 0.0, 9.80665]) + 0.02 * rng.standard_normal((time_s.size, 3))
    world = np.tile(FIELD, (time_s.size, 1)) if field is None else field(time_s)
    magnetometer = turn.inv().apply(world) + 0.004 * rng.standard_normal((time_s.size, 3))
    return turn, ImuLog(time_s, force, gyroscope, magnetometer, source="static")


def heading_deg(truth, orientation):
    turned = (orientation.rotations.world_from_sensor * truth.inv()).as_rotvec()
    return np.rad2deg(turned[:, 2])


@pytest.mark.parametrize("method", ["filter", "smoother"])
@pytest.mark.parametrize("seconds", [90.0, pytest.param(600.0, marks=pytest.mark.slow)])
def test_heading_of_a_static_sensor_stays(seconds, method):
    truth, log = static(seconds)
    heading = heading_deg(truth, orient(log, method=method))
    settled = heading[int(30 * RATE_HZ) :]
    # Measured 0.04 over 90 s; the target is 0.2 degrees over ten minutes after initialisation.
    assert np.abs(settled - settled[0]).max() < (0.07 if seconds < 100.0 else 0.2)


def test_without_a_magnetometer_the_heading_starts_at_zero():
    truth, log = static(30.0)
    found = orient(log, FusionSettings(use_magnetometer=False))
    turns = found.rotations.world_from_sensor
    first = turns[0].as_matrix()
    # Tilted by 0.36 rad, heading by the x axis and by the shortest turn differ by up to 0.36^2 / 4 rad: 1.9.
    assert abs(np.arctan2(first[1, 0], first[0, 0])) < np.deg2rad(2.0)
    up = [turn.inv().apply([0.0, 0.0, 1.0]) for turn in (turns[-1], truth)]
    assert up[0] @ up[1] > 0.9999


def with_field(log, field):
    return ImuLog(log.time_s, log.accelerometer_m_s2, log.gyroscope_rad_s, field)


@pytest.mark.parametrize("method", ["filter", "smoother"])
@pytest.mark.parametrize("noise", [0.0, 0.004])
def test_a_field_straight_down_tells_no_heading(method, noise):
    turn, log = static(20.0)
    off = noise * np.random.default_rng(4).standard_normal((len(log), 3))
    found = orient(
        with_field(log, np.tile(turn.inv().apply([0.0, 0.0, -1.0]), (len(log), 1)) + off), method=method
    )
    assert np.rad2deg(np.median(found.standard_deviation_rad[:, 2])) > 45.0
    assert any("heading is not known" in note for note in found.notes)
    assert np.isfinite(found.rotations.world_from_sensor.as_quat()).all()


def test_readings_in_other_units_are_refused():
    _, log = static(5.0)
    with pytest.raises(InvalidInputError, match=r"10 s.*milliseconds"):
        orient(ImuLog(1e3 * log.time_s, log.accelerometer_m_s2, log.gyroscope_rad_s))
    with pytest.raises(InvalidInputError, match="m/s"):
        orient(ImuLog(log.time_s, log.accelerometer_m_s2 / 9.81, log.gyroscope_rad_s))


def swung(seconds=20.0):
    """A sensor upside down, still for two seconds, then swung; exact readings, and its truth."""
    time_s = np.arange(1, round(100.0 * seconds) + 1) / 100.0
    swing = np.clip(time_s - 2.0, 0.0, None)
    angles = np.column_stack([np.sin(swing), np.pi + 0.8 * np.sin(1.7 * swing), 0.5 * np.sin(1.3 * swing)])
    truth = Rotation.from_euler("ZYX", angles)
    rate = (Rotation.concatenate([truth[:1], truth[:-1]]).inv() * truth).as_rotvec() * 100.0
    force, field = truth.inv().apply([0.0, 0.0, 9.80665]), truth.inv().apply([0.4, 0.0, -0.9])
    return truth, ImuLog(time_s, force, rate, field)


def worst_deg(truth, found):
    return float(np.rad2deg((found.rotations.world_from_sensor * truth.inv()).magnitude().max()))


@pytest.mark.parametrize("peak_m_s2", [500.0, 1e9])
def test_a_knock_does_not_tilt_it(peak_m_s2):
    # One reading of 500 m/s^2 is a velocity of 5 m/s that no hand had: believed, it tilts by 3 degrees.
    truth, log = swung()
    force = log.accelerometer_m_s2.copy()
    force[1000] += [peak_m_s2, 0.0, 0.0]
    assert worst_deg(truth, orient(replace(log, accelerometer_m_s2=force))) < 1.0
