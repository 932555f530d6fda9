"""Fields of a sequence to be written: those that its sweep was read with, and what else the sweep has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import OrientationSensor, RFSettings, Sweep, Tracker
from speckle3d.io.hdf5 import open_hdf5, reading
from speckle3d.io.plus.frames import SequenceFrames
from speckle3d.io.plus.own_fields import own_fields
from speckle3d.io.plus.record import SequenceRecord, number_text, read_record
from speckle3d.io.plus.transforms import (
    IMAGE,
    ORIENTATION,
    ends,
    fixed_transform,
    image_matrix,
    image_skew_rad,
    sensor_from_image,
    tracked_poses,
)
from speckle3d.io.sweeps import HDF5Frames

_EQUAL = 1e-9
"""How far two poses may differ to be the same: mm, and entries of a rotation that went through a file."""

_REPLACED = ("ProbeToTracker", "TrackerToProbe", "ReferenceToTracker", "TrackerToReference")


@dataclass(frozen=True)
class Rows:
    """What a header will say.

    Attributes
    ----------
    fields : dict
        Of the whole file, by MetaImage's names.
    frames : list of dict
        Of each frame.
    images : list of int or None
        The sweep's frame of each; None where the sweep has none.
    conjugated : bool
        Whether Q is written with the other sign.
    left_out : list of str
        What a sequence does not hold of the sweep.
    """

    fields: dict[str, str]
    frames: list[dict[str, str]]
    images: list[int | None]
    conjugated: bool
    left_out: list[str]

    def stored(self, frame: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Give Q the sign that it has in the file."""
        return np.conj(frame) if self.conjugated else frame

    def add_transforms(self, name: str, matrices: FloatArray) -> None:
        """Give the sweep's frames one more transform, shape (n, 4, 4), by a name as ``ImageToWorld``.

        It counts pixels, so that their spacing becomes 1: a viewer that knew both would apply it twice.

        Raises
        ------
        InvalidInputError
            If there are fewer or more transforms than frames.
        """
        count = sum(each is not None for each in self.images)
        if matrices.shape != (count, 4, 4):
            raise InvalidInputError(f"{name}: expected shape ({count}, 4, 4), got {matrices.shape}")
        self.fields["ElementSpacing"] = "1 1 1"
        for frame, i in zip(self.frames, self.images, strict=True):
            if i is not None:
                _add([frame], name, matrices[[i]], np.ones(1, dtype=bool))

    @property
    def is_plane(self) -> bool:
        """Whether this is an image of two axes, not a sequence of one."""
        return len(self.images) == 1 and self.fields.get("NDims") == "2"


def record_of_sweep(sweep: Sweep) -> SequenceRecord | None:
    """Find the fields that a sweep was read with from a sequence, now or before it became a sweep file."""
    if isinstance(sweep.frames, SequenceFrames):
        return sweep.frames.record
    if not isinstance(sweep.frames, HDF5Frames):
        return None
    path = sweep.frames.path
    with reading(path), open_hdf5(path) as file:
        return read_record(file)


def rows_of(sweep: Sweep) -> Rows:
    """Tell what the header of a sweep's sequence says.

    Raises
    ------
    FileError, InvalidInputError
        If the fields in the sweep's file do not make sense.
    """
    left_out: list[str] = []
    record = record_of_sweep(sweep)
    if record is not None and record.frames and np.count_nonzero(record.has_image) != len(sweep):
        left_out.append(
            f"the fields of {np.count_nonzero(record.has_image)} images, where the sweep has {len(sweep)}"
        )
        record = None
    record = record or SequenceRecord()
    has_image = record.has_image if record.frames else np.ones(len(sweep), dtype=bool)
    count = iter(range(len(sweep)))
    images = [next(count) if there else None for there in has_image]
    frames = [dict(each) for each in record.frames] or [{} for _ in images]
    times = _stamp(frames, images, sweep.frame_time_s)
    if sweep.tracker is not None:
        left_out += _add_tracker(sweep, sweep.tracker, record, frames, times)
    if sweep.orientation is not None:
        left_out += _add_orientation(sweep, sweep.orientation, frames, times)
    if sweep.truth is not None:
        left_out.append("the true poses")
    fields = (dict(record.fields) or _standard(sweep)) | own_fields(sweep)
    return Rows(fields, frames, images, record.conjugated, left_out)


def rows_without_images(times_s: FloatArray) -> Rows:
    """Rows of frames that have a time alone, to which transforms are added."""
    frames = [{"Timestamp": number_text(time)} for time in times_s.tolist()]
    return Rows({}, frames, [*range(len(frames))], False, [])


def _standard(sweep: Sweep) -> dict[str, str]:
    """Fields of a sweep that has none of its own.

    Spacing is 1 where transforms count pixels, as in PLUS: a viewer that knew both would apply it twice.
    """
    grid = sweep.grid
    is_rf = isinstance(sweep.signal, RFSettings)
    kind = "BRIGHTNESS" if not is_rf else "RF_IQ_LINE" if sweep.frames.dtype.kind == "c" else "RF_REAL"
    sizes = (grid.sample_spacing_mm, grid.vector_pitch_mm)
    sizes = sizes if is_rf else sizes[::-1]
    calibrated = sweep.tracker is not None and sweep.tracker.sensor_from_image is not None
    spacing = (1.0, 1.0, 1.0) if calibrated else (*sizes, 1.0)
    return {
        "UltrasoundImageOrientation": "FM" if is_rf else "MF",
        "UltrasoundImageType": kind,
        "ElementSpacing": " ".join(map(number_text, spacing)),
        "Offset": "0 0 0",
        "TransformMatrix": "1 0 0 0 1 0 0 0 1",
        "CenterOfRotation": "0 0 0",
        "AnatomicalOrientation": "RAI",
    }


def _stamp(frames: list[dict[str, str]], images: Sequence[int | None], times_s: FloatArray) -> FloatArray:
    """Give every frame its time; returns those of all, NaN where a frame without image has none."""
    times = np.full(len(frames), np.nan)
    for i, (frame, number) in enumerate(zip(frames, images, strict=True)):
        held = number_of(frame.get("Timestamp"))
        times[i] = held if number is None else times_s[number]
        if number is not None and held != times[i]:
            frame["Timestamp"] = number_text(times[i])
        if number is not None and not {"ImageStatus", "Status"} & frame.keys():
            frame["ImageStatus"] = "OK"
    return times


def number_of(text: str | None) -> float:
    """Read a number; NaN where there is none."""
    try:
        return float(text or "nan")
    except ValueError:
        return np.nan


def _add_tracker(
    sweep: Sweep, tracker: Tracker, record: SequenceRecord, frames: list[dict[str, str]], times: FloatArray
) -> list[str]:
    left_out: list[str] = []
    tool = ends(record.poses[0])[0] if record.poses else "Probe"
    if not _holds(record, tracker):
        tool = "Probe"
        if record.poses:
            left_out.append(
                f"{', '.join(record.poses)} of its own sequence, in place of which is its tracker"
            )
        for frame in frames:
            for name in _REPLACED:
                frame.pop(f"{name}Transform", None)
                frame.pop(f"{name}TransformStatus", None)
        at = times - tracker.time_offset_s
        covered = tracker.readings.covers(at)
        matrices = np.tile(np.eye(4), (len(frames), 1, 1))
        if covered.any():
            matrices[covered] = tracker.readings.at(at[covered]).as_matrix()
        _add(frames, "ProbeToTracker", matrices, covered)
        if not np.array_equal(tracker.readings.time_s, at[covered]):
            left_out.append(
                f"the tracker's {len(tracker.readings)} readings, of which {np.count_nonzero(covered)} "
                f"interpolated ones are at the times of {len(frames)} frames"
            )
    if tool == IMAGE:  # whose transforms count pixels
        return left_out
    _add_calibration(
        sweep, tracker.sensor_from_image, f"{IMAGE}To{tool}", record, frames, tracker.image_skew_rad
    )
    return left_out


def _holds(record: SequenceRecord, tracker: Tracker) -> bool:
    """Whether a sequence's own fields give the tracker's readings."""
    if not record.poses or tracker.time_offset_s:
        return False
    try:
        found = tracked_poses("", record.frames, *record.poses)
    except InvalidInputError:  # of an image whose frame a device set names otherwise
        return False
    if found is None or len(found.readings) != len(tracker.readings):
        return False
    held, own = found.readings, tracker.readings
    return np.array_equal(held.time_s, own.time_s) and _same(held.world_from_sensor, own.world_from_sensor)


def _same(a: RigidTransform, b: RigidTransform) -> bool:
    return bool(np.allclose(a.as_matrix(), b.as_matrix(), rtol=0, atol=_EQUAL))


def _add_calibration(
    sweep: Sweep,
    mounting: RigidTransform | None,
    name: str,
    record: SequenceRecord,
    frames: list[dict[str, str]],
    skew_rad: float = 0.0,
) -> None:
    if mounting is None:
        return
    grid = sweep.grid
    held = fixed_transform("", record.fields, record.frames, name)
    if (
        held is not None
        and _same(sensor_from_image(held, grid.first_sample_depth_mm, name), mounting)
        and abs(image_skew_rad(held, name) - skew_rad) < _EQUAL
    ):
        return
    sizes = grid.vector_pitch_mm, grid.sample_spacing_mm, grid.first_sample_depth_mm
    matrix = image_matrix(mounting, *sizes, skew_rad)
    _add(frames, name, np.tile(matrix, (len(frames), 1, 1)), np.ones(len(frames), dtype=bool))


def _add_orientation(
    sweep: Sweep, sensor: OrientationSensor, frames: list[dict[str, str]], times: FloatArray
) -> list[str]:
    at = times - sensor.time_offset_s
    covered = sensor.readings.covers(at)
    matrices = np.tile(np.eye(4), (len(frames), 1, 1))
    if covered.any():
        matrices[covered, :3, :3] = sensor.readings.at(at[covered]).as_matrix()
    _add(frames, f"{ORIENTATION}ToWorld", matrices, covered)
    if sensor.sensor_from_image is not None:
        mounting = RigidTransform.from_rotation(sensor.sensor_from_image)
        _add_calibration(sweep, mounting, f"{IMAGE}To{ORIENTATION}", SequenceRecord(), frames)
    return [
        f"the orientation sensor's {len(sensor.readings)} readings with what else it measured, of which "
        f"{np.count_nonzero(covered)} interpolated rotations are at the times of {len(frames)} frames"
    ]


def _add(frames: list[dict[str, str]], name: str, matrices: FloatArray, valid: BoolArray) -> None:
    for frame, matrix, is_valid in zip(frames, matrices, valid, strict=True):
        frame[f"{name}Transform"] = " ".join(map(number_text, matrix.ravel()))
        frame[f"{name}TransformStatus"] = "OK" if is_valid else "INVALID"
