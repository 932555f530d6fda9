"""Recordings of a handheld with a sensor inside, made from simulated sweeps."""

from dataclasses import replace

import numpy as np
from clarius_examples import write_package

from speckle3d.core.streams import TimedRotations

PITCH_MM = 0.3
"""Between the simulator's vectors."""

BURST, OF = 4, 9
"""Samples kept, of those of a sensor at 100 Hz: 44 a second, with pauses of 60 ms."""


def handheld(sweep):
    """The sweep as such a scanner records it: one clock, the sensor in bursts, its mounting not known."""
    sensor, start = sweep.orientation, sweep.frame_time_s[0] - 5.0
    burst = np.arange(len(sensor.readings)) % OF < BURST
    readings = TimedRotations(
        sensor.readings.time_s[burst] + sensor.time_offset_s - start,
        sensor.readings.world_from_sensor[burst],
    )
    vectors = {
        name: getattr(sensor, name)[burst]
        for name in ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au")
    }
    inside = replace(sensor, readings=readings, sensor_from_image=None, time_offset_s=0.0, **vectors)
    times = sweep.frame_time_s - start
    return replace(sweep, frame_time_s=times, orientation=inside, tracker=None, truth=None)


def write_handheld(path, sweep):
    """Write the sweep's package, packed, under the file's own name."""
    return write_package(path, handheld(sweep), lzop=True, element_mm=PITCH_MM, name=path.stem)
