from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.app.sweep.streams import streams_of
from speckle3d.core.streams import TimedPoses
from speckle3d.core.sweep import Tracker


def test_every_stream_is_on_the_images_clock_with_its_unit(sweep):
    streams = streams_of(sweep)
    assert list(streams) == ["orientation sensor", "tracker"]
    units = {each.name: each.unit for some in streams.values() for each in some}
    assert units == {
        "turn of the image": "degrees", "rate of turn": "degrees/s", "acceleration": "m/s²",
        "magnetic field": "a.u.", "path of the image's centre": "mm",
    }  # fmt: skip
    turn = streams["orientation sensor"][0]
    sensor = sweep.orientation
    np.testing.assert_allclose(turn.time_s, sensor.readings.time_s + sensor.time_offset_s)
    rates = streams["orientation sensor"][1]
    np.testing.assert_allclose(rates.values, np.degrees(sensor.gyroscope_rad_s))


def test_the_trackers_path_is_that_of_the_images_centre_seen_from_its_first_reading(sweep):
    path = streams_of(sweep)["tracker"][0]
    poses = sweep.tracker.readings.world_from_sensor * sweep.tracker.sensor_from_image
    centre = sweep.grid.centre_mm
    expected = poses[0].inv().apply(poses[150].apply(centre)) - centre
    np.testing.assert_allclose(path.values[150], expected, atol=1e-9)


def test_lines_are_broken_where_readings_are_missing(sweep):
    still = RigidTransform.identity(5)
    readings = TimedPoses(np.array([0.0, 0.1, 0.2, 1.0, 1.1]), still)
    streams = streams_of(replace(sweep, orientation=None, tracker=Tracker(readings, None, 0.5)))
    assert list(streams) == ["tracker"]
    path = streams["tracker"][0]
    assert path.name == "path of the sensor"
    np.testing.assert_allclose(path.time_s, [0.5, 0.6, 0.7, 1.5, 1.5, 1.6])
    assert np.flatnonzero(np.isnan(path.values[:, 0])).tolist() == [3]


def test_a_sweep_without_sensors_has_no_streams(sweep):
    assert streams_of(replace(sweep, orientation=None, tracker=None)) == {}
