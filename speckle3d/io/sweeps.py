"""Reading of the sweep file, versions 1 and 2 (with I/Q); frames stay on disk."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import AnyArray, FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.geometry import (
    require_finite,
    require_increasing,
    rotations_from_quaternions,
    transforms_from_matrices,
)
from speckle3d.core.grid import FanLines, ImageGrid
from speckle3d.core.printable import printable
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import INERTIAL, BModeSettings, OrientationSensor, RFSettings, Sweep, Tracker
from speckle3d.io.frames import FileFrames, HDF5Slices
from speckle3d.io.hdf5 import (
    Node,
    Source,
    file_format,
    find_member,
    has_member,
    locate,
    open_family,
    read_array,
    read_attribute,
    read_text,
    read_transforms,
    read_vector_attribute,
    require_dataset,
    require_group,
    require_shape,
)
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording
from speckle3d.io.records import read_record

FORMAT = "speckle3d.sweep"
VERSION, IQ_VERSION, FAN_VERSION = 1, 2, 3
"""Of files of parallel vectors without and with I/Q, and of a fan of vectors."""

GROWING = "unfinished"
"""Data set of files that grow as they are recorded: 0 once the recording has been closed."""

MEMBERS = frozenset({"rf", "iq", "bmode", "frame_time_s", "orientation", "tracker", "truth", "fan", GROWING})
"""Members of the root that these versions of the format give a meaning to."""

SAMPLE_TYPES = {"rf": ("int16", "float32"), "iq": ("complex64", "int16"), "bmode": ("uint8",)}
"""Types that the samples of each kind may have in the file; int16 of I/Q in pairs, I first."""

_SENSORS: dict[str, tuple[str, str, tuple[int, ...], Callable[[FloatArray, str], Any]]] = {
    "orientation": ("quaternion_wxyz", "sensor_from_image_wxyz", (4,), rotations_from_quaternions),
    "tracker": ("world_from_sensor", "sensor_from_image", (4, 4), transforms_from_matrices),
}
"""Of each sensor, its data set of readings, its attribute of the image's place, and the shape of both."""


class SweepSlices(HDF5Slices):
    """Opens the frames of a sweep file."""


def from_pairs(pairs: npt.NDArray[np.int16]) -> npt.NDArray[np.complex64]:
    """Complex samples of pairs of I and Q, the last axis."""
    return pairs.astype(np.float32).view(np.complex64)[..., 0]


def open_sweep(source: Source, _: ImportSettings | None = None) -> Recording:
    """Read a sweep file; its frames stay on disk until they are asked for."""
    with open_family(source, FORMAT, (VERSION, IQ_VERSION, FAN_VERSION)) as file:
        path = Path(file.filename)
        clock = _Clock.of(file, "frame_time_s")
        count = clock.time_s.size
        if not count:
            raise InvalidInputError(f"{locate(file)}: expected a frame, got none so far")
        frames, grid, signal = _read_image(clock)
        truth = find_member(file, "truth")
        sweep = Sweep(
            frames=frames,
            grid=grid,
            signal=signal,
            frame_time_s=clock.time_s,
            orientation=_read_sensor(file, "orientation"),
            tracker=_read_sensor(file, "tracker"),
            truth=None if truth is None else read_transforms(truth, "world_from_image", count),
            name=printable(path.stem),
            probe=read_text(file, "probe", ""),
        )
    if not clock.is_growing:
        return Recording(path, ready=sweep)
    words = "goes on, or was ended without being closed"
    note = (
        f"{path}: the recording {words}: {count} frames so far, of which speckle3d convert makes a whole file"
    )
    return Recording(path, ready=sweep, rows=(("recording", words, ""),), remarks=(note,))


@dataclass(frozen=True)
class _Clock:
    """Times of the rows of a group, shape (n,); of a file that grows, other data may have more rows."""

    group: h5py.Group
    time_s: FloatArray
    is_growing: bool

    @classmethod
    def of(cls, group: h5py.Group, name: str = "time_s") -> _Clock:
        file, times = group.file, read_array(group, name, ("row",))
        is_growing = file.swmr_mode or (
            has_member(file, GROWING) and bool(read_array(file, GROWING, (), np.bool_))
        )
        if is_growing and np.isnan(times).any():  # of rows that are being written
            times = times[: np.argmax(np.isnan(times))]
        return cls(group, require_increasing(times, locate(group, name)), is_growing)

    def shape(self, *row: int | str) -> tuple[int | str, ...]:
        """Shape of a data set with a row of a shape for each time."""
        return ("row" if self.is_growing else self.time_s.size, *row)

    def rows(self, name: str, *row: int, dtype: npt.DTypeLike = np.float64) -> AnyArray:
        """Read the rows of a data set that have a time."""
        return read_array(self.group, name, self.shape(*row), dtype)[: self.time_s.size]


def _read_image(clock: _Clock) -> tuple[FileFrames, ImageGrid, RFSettings | BModeSettings]:
    """Frames of a file, as many as it has times for."""
    file = clock.group
    name = next((name for name in SAMPLE_TYPES if has_member(file, name)), None)
    if name is None:
        raise InvalidInputError(f"{locate(file)}: expected a data set rf, iq or bmode, got none of them")
    node, where = require_dataset(file, name), locate(file, name)
    dtype = node.dtype.newbyteorder("=")
    require_sample_type(name, dtype, where)
    in_pairs = name == "iq" and dtype == np.int16
    require_shape(node, clock.shape("vector", "sample", *((2,) if in_pairs else ())), where)
    vectors, samples = node.shape[1:3]
    slices = SweepSlices(Path(file.filename).absolute(), (name,), from_pairs if in_pairs else np.asarray)
    shape, kind = (clock.time_s.size, vectors, samples), np.complex64 if in_pairs else dtype
    with naming(where):
        if name == "iq":
            read_attribute(node, "demodulation_frequency_hz")
        signal = read_signal(node, name)
        if isinstance(signal, RFSettings):
            pitch_mm, spacing_mm = read_attribute(node, "vector_pitch_mm"), signal.sample_spacing_mm
        else:
            pitch_mm, spacing_mm = (
                read_attribute(node, key) for key in ("column_pitch_mm", "row_spacing_mm")
            )
        grid = read_record(
            node,
            ImageGrid,
            vectors=vectors,
            samples=samples,
            vector_pitch_mm=pitch_mm,
            sample_spacing_mm=spacing_mm,
            fan=read_record(require_group(file, "fan"), FanLines) if has_member(file, "fan") else None,
        )
        return slices.frames(shape, kind, stored_dtype=dtype), grid, signal


def require_sample_type(name: str, dtype: np.dtype[Any], where: str) -> None:
    """Raise `InvalidInputError` unless /rf, /iq or /bmode may hold samples of a type."""
    if dtype.name not in SAMPLE_TYPES[name]:
        expected = " or ".join(SAMPLE_TYPES[name])
        raise InvalidInputError(f"{where}: expected samples of type {expected}, got {dtype}")


def read_signal(node: Node, kind: str) -> RFSettings | BModeSettings:
    """Read how samples of a kind, rf, iq or bmode, were made."""
    return read_record(node, BModeSettings) if kind == "bmode" else read_record(node, RFSettings)


def _read_sensor(file: h5py.File, name: str) -> Any:
    """The orientation sensor or the tracker; None where there is none, or none of its readings is valid."""
    if not has_member(file, name):
        return None
    group = require_group(file, name)
    clock, vectors = _Clock.of(group), dict[str, FloatArray]()
    valid = np.ones(clock.time_s.size, dtype=bool)
    if has_member(group, "valid"):
        valid = clock.rows("valid", dtype=np.bool_)
    if not valid.any():
        return None
    readings, mounting, shape, check = _SENSORS[name]
    values = clock.rows(readings, *shape)
    # Invalid samples may hold anything; replaced, not dropped, so that indices in messages stay right.
    values[~valid] = np.eye(4)[0] if shape == (4,) else np.eye(4)
    world_from_sensor, sensor_from_image = check(values, locate(group, readings))[valid], None
    if mounting in group.attrs:
        numbers = read_vector_attribute(group, mounting, math.prod(shape))
        sensor_from_image = check(numbers.reshape(1, *shape), f"{locate(group)} attribute {mounting}")[0]
    for vector in INERTIAL:
        if has_member(group, vector):
            vectors[vector] = clock.rows(vector, 3)[valid]
            require_finite(vectors[vector], locate(group, vector))
    offset_s, skew_rad = (read_attribute(group, key, 0.0) for key in ("time_offset_s", "image_skew_rad"))
    times = clock.time_s[valid]
    with naming(locate(group)):
        if name == "tracker":
            return Tracker(TimedPoses(times, world_from_sensor), sensor_from_image, offset_s, skew_rad)
        return OrientationSensor(
            TimedRotations(times, world_from_sensor), sensor_from_image, offset_s, **vectors
        )


READER = Reader(
    FORMAT, None, open_sweep, claims_hdf5=lambda file: file_format(file) == FORMAT, takes_settings=False
)
