"""Simulated sensors: each on its own clock, with the errors that its model states."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

from speckle3d.simulation.movement import hand_sweep, world_from_medium
from speckle3d.simulation.sensors import (
    LEVER_MM,
    TRACKER_FROM_IMAGE,
    simulate_orientation,
    simulate_tracker,
)
from speckle3d.simulation.settings import SimulationSettings

SPAN_S = (-0.3, 20.3)
FRAMES_S = np.arange(500) / 25.0


@pytest.fixture(scope="module")
def trajectory():
    rng = np.random.default_rng(11)
    return hand_sweep(SimulationSettings(), 20.0, 37.8, world_from_medium(0.6), rng)


def test_tracker_errors_are_the_stated_jitter(trajectory):
    tracker = simulate_tracker(trajectory, SPAN_S, np.random.default_rng(1))
    times = tracker.readings.time_s + tracker.time_offset_s
    true = trajectory.world_from_image(times) * TRACKER_FROM_IMAGE.inv()
    error = true.inv() * tracker.readings.world_from_sensor
    # About 1000 samples: standard deviations to 2.2 %; four standard errors.
    shift = tracker.readings.world_from_sensor.translation - true.translation
    assert shift.std(axis=0) == pytest.approx([0.15] * 3, rel=0.09)
    assert np.rad2deg(error.rotation.as_rotvec()).std(axis=0) == pytest.approx([0.1] * 3, rel=0.09)


def test_tracker_latency_is_recorded_and_undone(trajectory):
    tracker = simulate_tracker(trajectory, SPAN_S, np.random.default_rng(1), 0.0)
    assert tracker.time_offset_s == pytest.approx(-0.04)
    error = trajectory.world_from_image(FRAMES_S).inv() * tracker.world_from_image(FRAMES_S)
    # Linear interpolation over 20 ms of tremor: (2 pi 12)^2 0.012 mm (20 ms)^2 / 8, peaks five times that,
    # and a 110 mm lever with 0.016 deg of tremor.
    assert np.abs(error.translation).max() < 0.1
    late = replace(tracker, time_offset_s=0.0).world_from_image(FRAMES_S[10:])
    assert np.abs(late.translation - tracker.world_from_image(FRAMES_S[10:]).translation).mean() > 0.02


def test_exact_raw_readings_integrate_to_the_orientation_and_the_path(trajectory):
    sensor = simulate_orientation(trajectory, SPAN_S, np.random.default_rng(1), 0.0)
    readings = sensor.readings
    rates = sensor.gyroscope_rad_s
    steps = (readings.world_from_sensor[:-1].inv() * readings.world_from_sensor[1:]).as_rotvec()
    dt = np.diff(readings.time_s)[:, None]
    # The trapezoidal rule on 12 Hz over 10 ms: (2 pi 12 0.01)^2 / 12 of the largest step.
    worst = np.abs(steps).max()
    np.testing.assert_allclose(dt * (rates[1:] + rates[:-1]) / 2, steps, atol=0.06 * worst)

    # The accelerometer feels gravity and the sweep.
    force = sensor.readings.world_from_sensor.apply(sensor.accelerometer_m_s2)
    assert force.mean(axis=0) == pytest.approx([0.0, 0.0, 9.81], abs=0.01)
    # Integrated twice, the specific force less gravity is the sensor's own path.
    times = sensor.readings.time_s + sensor.time_offset_s
    speed = cumulative_trapezoid(1e3 * (force - [0, 0, 9.81]), times, axis=0, initial=0)
    path = cumulative_trapezoid(speed, times, axis=0, initial=0)
    true = trajectory.world_from_image(times).apply(LEVER_MM)
    line = np.stack([np.ones_like(times), times], axis=1)
    residual = (true - path) - line @ np.linalg.lstsq(line, true - path, rcond=None)[0]
    # Half a percent of the 20 mm travelled: sums of 100 Hz samples are no integrals.
    assert np.abs(residual).max() < 0.1
