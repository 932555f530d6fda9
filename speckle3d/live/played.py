"""Convert a sweep to the messages that PLUS sends while recording.

RF has the samples of a vector as the columns of its images, as PLUS sends it, B-mode stands upright.
"""

import heapq
import math
from collections.abc import Iterator
from typing import TypeAlias

import numpy as np

from speckle3d.core.arrays import AnyArray, FloatArray
from speckle3d.core.geometry import rigid
from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import Frames, OrientationSensor, Sweep, Tracker
from speckle3d.io.igtl.messages import packed_image, packed_transform
from speckle3d.live.frames import message_matrix

Played: TypeAlias = tuple[float, bytes, bool]
"""When a message was sent, s from the first frame, the message, and whether it is an image."""


def played(
    sweep: Sweep,
    frames: Frames,
    grid: ImageGrid,
    upright: bool,
    later_s: float,
) -> Iterator[Played]:
    """Make messages of a sweep, in the order of their times; each carries its own time.

    Devices are Image_Reference, ProbeToReference of the tracker and ProbeToWorld of the orientation sensor.

    Parameters
    ----------
    sweep : Sweep
    frames : Frames
        To be sent: the sweep's, or images made of them.
    grid : ImageGrid
        Of these.
    upright : bool
        Whether vectors are columns of the images, or their rows.
    later_s : float
        Added to the times in the messages.

    Raises
    ------
    InvalidInputError
        If a message cannot hold the frames, or a time.
    """
    first_s = float(sweep.frame_time_s[0])

    def images() -> Iterator[Played]:
        for i, time_s in enumerate(sweep.frame_time_s):
            pixels, place = _pixels(frames, i, upright), _place(sweep, grid, upright, i)
            message = packed_image("Image_Reference", time_s + later_s, pixels, place, pixels.ndim - 1)
            yield float(time_s) - first_s, message, True

    sensors = {"ProbeToReference": sweep.tracker, "ProbeToWorld": sweep.orientation}.items()
    readings = (_readings(sensor, name, first_s, later_s) for name, sensor in sensors if sensor is not None)
    return heapq.merge(images(), *readings, key=lambda message: message[0])


def clock_shift_s(sweep: Sweep) -> float:
    """Whole seconds to add to a sweep's times: messages hold no negative times."""
    sensors = (sweep.tracker, sweep.orientation)
    clocks = sweep.frame_time_s, *(sensor.readings.time_s for sensor in sensors if sensor is not None)
    earliest_s = min(float(times[0]) for times in clocks)
    return float(max(0, math.ceil(-earliest_s)))


def _readings(
    sensor: Tracker | OrientationSensor, name: str, first_s: float, later_s: float
) -> Iterator[Played]:
    matrices = rigid(sensor.readings.world_from_sensor).as_matrix()
    for time_s, matrix in zip(sensor.readings.time_s, matrices, strict=True):
        # Sent when the image of the same moment is; it tells its own clock.
        at_s = float(time_s) + sensor.time_offset_s - first_s
        yield at_s, packed_transform(name, time_s + later_s, matrix), False


def _pixels(frames: Frames, i: int, upright: bool) -> AnyArray:
    """Pixels (column, row) of a frame, (column, row, 2) of I and Q."""
    frame = frames[i]
    if frame.dtype.kind == "c":
        frame = np.ascontiguousarray(frame, np.complex64).view(np.float32).reshape(*frame.shape, 2)
    elif frame.dtype.kind == "f" and upright:
        frame = np.clip(np.round(np.nan_to_num(frame)), 0, 255).astype(np.uint8)
    return frame if upright else frame.swapaxes(0, 1)


def _place(sweep: Sweep, grid: ImageGrid, upright: bool, i: int) -> FloatArray:
    """Where the pixels of a frame lie, (4, 4): in the world of a calibrated tracker, else in the image."""
    image_from_pixel = message_matrix(grid, upright)
    tracker, time_s = sweep.tracker, sweep.frame_time_s[i]
    if tracker is None or tracker.sensor_from_image is None or not tracker.covers(time_s):
        return image_from_pixel
    return tracker.world_from_image(time_s).as_matrix() @ image_from_pixel
