"""Recordings, points of a phantom in them joined with its poses, and names of what they determine."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.geometry import rigid
from speckle3d.core.grid import ImageGrid
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import Frames
from speckle3d.core.text import shown

SOME_FRAMES = 100
"""Frames that choose among starting points; the answer is refined from all."""

SeenAs = Literal["line", "direction", "dot"]
"""What points are: the two ends of a line, the direction of one, or a dot."""

SCALES = ("s_x", "s_y")
ANGLES = ("alpha", "beta", "gamma")
POSE = ("x", "y", "z", *ANGLES)
"""``sensor_from_image`` (the report's R_T_P): position, mm, and angles about z, y and x (roll, yaw, tilt),
rad."""
PROBE = (*SCALES, *POSE)
TARGET = ("x_c", "y_c", "z_c", "alpha_c", "beta_c", "gamma_c")
"""``target_from_world`` (the report's C_T_T)."""
CHAIN = (*PROBE, *TARGET)


def columns_of(names: Sequence[str]) -> list[int]:
    """Columns of parameters in `CHAIN`."""
    return [CHAIN.index(name) for name in names]


def in_chain(names: Sequence[str], covariance: FloatArray) -> FloatArray:
    """Covariance of all of `CHAIN` from that of some, zero for the others, shape (14, 14)."""
    full, columns = np.zeros((len(CHAIN), len(CHAIN))), columns_of(names)
    full[np.ix_(columns, columns)] = covariance
    return full


@dataclass(frozen=True)
class Recording:
    """Images and the readings of a sensor on the probe.

    Parameters
    ----------
    images : Frames, shape (n, column, row)
        Grey levels; of a fan scan converted.
    grid : ImageGrid
        Of the images; rough where pixels are to be estimated.
    frame_time_s : ndarray, shape (n,)
    readings : TimedPoses or TimedRotations
        World from sensor.
    time_offset_s : float
        A reading at t belongs to image time t + `time_offset_s`.
    name : str
        For messages.
    mounting : RigidTransform, optional
        Sensor from image, as the file has it.
    """

    images: Frames
    grid: ImageGrid
    frame_time_s: FloatArray
    readings: TimedPoses | TimedRotations
    time_offset_s: float = 0.0
    name: str = "recording"
    mounting: RigidTransform | None = None

    @property
    def pixel_mm(self) -> FloatArray:
        """Distance between columns and between rows, shape (2,)."""
        return np.array([self.grid.vector_pitch_mm, self.grid.sample_spacing_mm])

    @property
    def first_px(self) -> FloatArray:
        """Place of the first column and of the first row, from the image's origin, in columns and rows."""
        return np.array([self.grid.first_vector_mm, self.grid.first_sample_depth_mm]) / self.pixel_mm

    def covered(self) -> IntArray:
        """Numbers of the frames that the readings cover."""
        return np.flatnonzero(self.readings.covers(self.frame_time_s - self.time_offset_s))

    def world_from_sensor(self, frames: IntArray, offset_s: float | None = None) -> RigidTransform:
        """Pose of the sensor at frames by number, by a clock that is off by `offset_s` if not by its own."""
        at_s = self.frame_time_s[frames] - (self.time_offset_s if offset_s is None else offset_s)
        return rigid(self.readings.at(at_s))


@shown
@dataclass(frozen=True)
class ImagePoints:
    """Points of a phantom in the images, and where the sensor was.

    Parameters
    ----------
    pixels : ndarray, shape (n, 2)
        Column u and row v, fractional.
    frame : ndarray of int, shape (n,)
        The frame each point is in; points of a frame are used or dropped together.
    world_from_sensor : RigidTransform, length n
        Translation in mm.
    wire : ndarray of int, shape (n,), optional
        The wire each point lies on.
    time_s : ndarray, shape (n,), optional
        When each point's frame was taken; without it, frames are taken to be evenly spaced. A sensor's error
        wanders with it.
    """

    pixels: FloatArray
    frame: IntArray
    world_from_sensor: RigidTransform
    wire: IntArray | None = None
    time_s: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.pixels)

    def __getitem__(self, index: BoolArray | IntArray | slice) -> ImagePoints:
        wire = None if self.wire is None else self.wire[index]
        time_s = None if self.time_s is None else self.time_s[index]
        return ImagePoints(self.pixels[index], self.frame[index], self.world_from_sensor[index], wire, time_s)

    @cached_property
    def turns(self) -> FloatArray:
        """Rotation matrices of the poses, shape (n, 3, 3)."""
        return np.ascontiguousarray(self.world_from_sensor.as_matrix()[:, :3, :3])

    @cached_property
    def shifts_mm(self) -> FloatArray:
        """Translations of the poses, shape (n, 3)."""
        return self.world_from_sensor.translation

    @property
    def wires(self) -> IntArray:
        """`wire`, which must be known."""
        if self.wire is None:
            raise InvalidInputError("points: expected the wire of each, got none")
        return self.wire

    @cached_property
    def frames(self) -> IntArray:
        """Numbers of the frames that have points, ascending."""
        return np.unique(self.frame)

    def of_some_frames(self, count: int) -> ImagePoints:
        """The points of at most `count` frames, spread evenly over the recording.

        Raises
        ------
        InsufficientDataError
            If no frame has any.
        """
        if not len(self):
            raise InsufficientDataError("expected the phantom in several frames, got it in none")
        places = np.unique(np.linspace(0, len(self.frames) - 1, count).astype(int))
        return self[np.isin(self.frame, self.frames[places])]

    @property
    def times(self) -> FloatArray:
        """`time_s`, or the frames' numbers where times are not known, shape (n,)."""
        return np.asarray(self.frame, dtype=float) if self.time_s is None else self.time_s

    @classmethod
    def of_lines(
        cls,
        frame: IntArray,
        points_px: FloatArray,
        world_from_sensor: RigidTransform,
        time_s: FloatArray | None = None,
    ) -> ImagePoints:
        """Two points of a line in each frame: m frames, poses and times, `points_px` of shape (m, 2, 2)."""
        twice = np.repeat(np.arange(len(frame)), 2)
        times = None if time_s is None else time_s[twice]
        poses = world_from_sensor[twice]
        return cls(points_px.reshape(-1, 2), frame[twice], poses, time_s=times)


@dataclass(frozen=True)
class Detections:
    """Lines or dots found in the images of a recording.

    Attributes
    ----------
    frame : ndarray of int, shape (m,)
        Of each line, or of each dot; ascending.
    pixels : ndarray, shape (m, 2, 2) for lines, (m, 2) for dots
        Column and row, fractional, of two points on each line, or of each dot.
    wire : ndarray of int, shape (m,), optional
        Number of the wire that each dot shows.
    dropped : dict of int to str
        Why other frames show nothing.
    score : ndarray, shape (m,), optional
        Contrast of dots that are not yet assigned to wires, grey levels; the strongest of a frame first.
    """

    frame: IntArray
    pixels: FloatArray
    wire: IntArray | None = None
    dropped: dict[int, str] = field(default_factory=dict)
    score: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.frame)

    def __getitem__(self, index: BoolArray | IntArray) -> Detections:
        wire = None if self.wire is None else self.wire[index]
        score = None if self.score is None else self.score[index]
        return Detections(self.frame[index], self.pixels[index], wire, self.dropped, score)

    def without(self, frames: Collection[int], reason: str) -> Detections:
        """Leave out frames, for the same reason each, whether anything was found in them or not."""
        selection = self[~np.isin(self.frame, list(frames))]
        return replace(selection, dropped={**self.dropped, **dict.fromkeys(frames, reason)})

    @property
    def are_lines(self) -> bool:
        """Whether lines were found, not dots."""
        return self.pixels.ndim == 3

    def points(self, world_from_sensor: RigidTransform, time_s: FloatArray | None = None) -> ImagePoints:
        """Join with the sensor's pose and the time of each line or dot."""
        if self.are_lines:
            return ImagePoints.of_lines(self.frame, self.pixels, world_from_sensor, time_s)
        return ImagePoints(self.pixels, self.frame, world_from_sensor, self.wire, time_s)


def as_directions(lines: ImagePoints, pixel_mm: FloatArray) -> ImagePoints:
    """Directions of lines given by two points each, of length one; their poses keep the rotation alone."""
    turns = RigidTransform.from_rotation(lines.world_from_sensor[::2].rotation)
    along = lines.pixels[1::2] - lines.pixels[::2]
    along = along / np.linalg.norm(along * pixel_mm, axis=1, keepdims=True)
    return replace(lines[::2], pixels=along, world_from_sensor=turns)


def affine_equations(places: FloatArray, rows: FloatArray) -> FloatArray:
    """Equations of points of an image in its origin and two axes, shape (..., r, 9).

    Parameters
    ----------
    places : ndarray, shape (..., 2)
        In the image.
    rows : ndarray, shape (..., r, 3)
        Of each point's equations for its position.
    """
    homogeneous = np.concatenate([np.ones((*places.shape[:-1], 1)), places], axis=-1)
    return np.asarray(np.einsum("...k,...ri->...rki", homogeneous, rows).reshape(*rows.shape[:-1], 9))
