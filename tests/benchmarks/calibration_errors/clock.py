"""The clock of a tracker, estimated with a plane's calibration: errors against what is claimed of them.

The tracker samples at 50 Hz, regularly, irregularly or with samples lost, with errors that are white or
wander besides.
"""

from dataclasses import replace

import numpy as np
from floor_scenes import Floor

from calibration.points import Detections, Recording
from speckle3d.calibrating.phantoms import solve_phantom
from speckle3d.calibrating.settings import PlaneSettings
from speckle3d.core.errors import Speckle3DError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.streams import TimedPoses

from .rows import Row, trials

TRACKER_HZ, COUNT = 50.0, 100
LARGEST_Z, WORST_S = 1.2, 0.004
MOTION = "motion"
"""Refused with the true clock, too: the motion does not determine the calibration."""


def simulate_recording(seed):
    """A recording of a plane, its lines, and its clock's true offset, s."""
    floor = Floor([seed, 50])
    rng, frame_s = floor.rng, floor.time_s
    sensor_s = np.arange(rng.uniform(0.0, 0.02) - 1.0, frame_s[-1] + 1.0, 1.0 / TRACKER_HZ)
    kind, offset_s = rng.integers(3), rng.uniform(-0.2, 0.2)
    if kind == 1:
        sensor_s += rng.uniform(-0.1, 0.1, sensor_s.size) / TRACKER_HZ
    if kind == 2:
        sensor_s = sensor_s[rng.random(sensor_s.size) > 0.05]
    readings = TimedPoses(sensor_s - offset_s, floor.readings(sensor_s, drifts=bool(seed % 2)))
    images, pixel_mm = np.zeros((len(frame_s), 2, 2), np.uint8), floor.pixel_mm * rng.uniform(0.99, 1.01, 2)
    recording = Recording(images, ImageGrid(2, 2, *pixel_mm), frame_s, readings)
    return recording, Detections(np.arange(len(frame_s)), floor.lines(frame_s)), offset_s


def judge(seed):
    """Error and claimed error of the offset, s, and why there is none."""
    recording, lines, offset_s = simulate_recording(seed)
    settings = PlaneSettings(fixed_pixels=seed % 4 < 2, reflector="bar")
    try:
        offset = solve_phantom(
            recording, lines, settings.model_copy(update={"time_offset_s": "estimate"})
        ).offset
    except Speckle3DError as error:
        try:
            solve_phantom(replace(recording, time_offset_s=offset_s), lines, settings)
        except Speckle3DError:
            return np.nan, np.nan, MOTION
        return np.nan, np.nan, str(error)
    return offset.seconds - offset_s, offset.standard_error_s, ""


def measure(share, first_seed):
    """RMS of the errors over what is claimed, the worst error, and how many were refused for the clock."""
    outcomes = trials(judge, range(first_seed, first_seed + max(6, round(share * COUNT))))
    pairs = np.array([o[:2] for o in outcomes if not o[2]])
    motion = sum(o[2] == MOTION for o in outcomes)
    rms, worst = np.sqrt(np.mean((pairs[:, 0] / pairs[:, 1]) ** 2)), np.abs(pairs[:, 0]).max()
    clock = len(outcomes) - len(pairs) - motion
    text = (
        f"RMS z {rms:.2f}, worst {1e3 * worst:.1f} ms, claimed {1e3 * np.median(pairs[:, 1]):.2f} (median); "
        f"of {len(outcomes)} recordings {clock} refused for the clock, {motion} with the true clock too"
    )
    is_on_target = bool(rms <= LARGEST_Z and worst <= WORST_S and clock == 0)
    return [Row("clock", text, "RMS z <= 1.2, worst <= 4 ms", is_on_target)]
