"""Reading of the sweep file, versions 1 and 2 (with I/Q); frames stay on disk."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from speckle3d.core.arrays import AnyArray, FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.geometry import require_finite, rotations_from_quaternions, transforms_from_matrices
from speckle3d.core.grid import FanLines, ImageGrid
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import INERTIAL, BModeSettings, OrientationSensor, RFSettings, Sweep, Tracker
from speckle3d.core.text import printable
from speckle3d.io.family.records import read_record
from speckle3d.io.frames import FileFrames, HDF5Slices, from_pairs
from speckle3d.io.hdf5 import (
    Node,
    file_format,
    locate,
    open_family,
    read_array,
    read_attribute,
    read_text,
    read_transforms,
    read_vector_attribute,
    require_dataset,
    require_group,
)
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording

FORMAT = "speckle3d.sweep"
VERSIONS = (1, 2, 3)
"""Of files of parallel vectors without and with I/Q, and of a fan of vectors."""

GROWING = "unfinished"
"""Data set of files that grow as they are recorded: 0 once the recording has been closed."""

SAMPLE_TYPES = {"rf": ("int16", "float32"), "iq": ("complex64", "int16"), "bmode": ("uint8",)}
"""Types that the samples of each kind may have in the file; int16 of I/Q in pairs, I first."""

SENSORS: dict[str, tuple[str, str, tuple[int, ...], Callable[[FloatArray, str], Any]]] = {
    "orientation": ("quaternion_wxyz", "sensor_from_image_wxyz", (4,), rotations_from_quaternions),
    "tracker": ("world_from_sensor", "sensor_from_image", (4, 4), transforms_from_matrices),
}
"""Of each sensor, its data set of readings, its attribute of the image's place, and the shape of both."""
MEMBERS = frozenset({*SAMPLE_TYPES, *SENSORS, "frame_time_s", "truth", "fan", GROWING})
"""Members of the root that these versions of the format give a meaning to."""


def open_sweep(source: h5py.File, _: ImportSettings) -> Recording:
    """Read a sweep file; its frames stay on disk until they are asked for."""
    with open_family(source.filename, FORMAT, VERSIONS) as file:
        path, times_s, is_growing = Path(file.filename), _times(file, "frame_time_s"), _is_growing(file)
        if not times_s.size:
            raise InvalidInputError(f"{path}: expected a frame, got none so far")
        frames, grid, signal = _read_image(file, times_s.size)
        has_truth = "truth" in file
        sweep = Sweep(
            frames=frames,
            grid=grid,
            signal=signal,
            frame_time_s=times_s,
            orientation=_read_sensor(file, "orientation"),
            tracker=_read_sensor(file, "tracker"),
            truth=read_transforms(file, "truth/world_from_image", times_s.size) if has_truth else None,
            name=printable(path.stem),
            probe=read_text(file, "probe", ""),
        )
    if not is_growing:
        return Recording(path, ready=sweep)
    words = "goes on, or was ended without being closed"
    advice = f"{len(sweep)} frames so far, of which speckle3d convert makes a whole file"
    remarks = (f"{path}: the recording {words}: {advice}",)
    return Recording(path, ready=sweep, rows=(("recording", words, ""),), remarks=remarks)


def _is_growing(file: h5py.File) -> bool:
    """Whether a file is being recorded, or was when its writer ended: data may have rows without a time."""
    return file.swmr_mode or (GROWING in file and bool(read_array(file, GROWING, ())))


def _times(group: h5py.Group, name: str = "time_s") -> FloatArray:
    """Times of the rows of a group, shape (n,); NaN are of rows that are being written."""
    times = read_array(group, name, ("row",))
    if _is_growing(group.file):
        times = times[: np.argmax(np.isnan([*times, np.nan]))]
    return times


def _length(file: h5py.File, count: int) -> int | str:
    """Length of a data set with a row for each of `count` times; free of one that grows: it may be more."""
    return "row" if _is_growing(file) else count


def _rows(group: h5py.Group, name: str, count: int, *row: int) -> AnyArray:
    """Read the rows of a data set that have a time."""
    return read_array(group, name, (_length(group.file, count), *row))[:count]


def _read_image(file: h5py.File, count: int) -> tuple[FileFrames, ImageGrid, RFSettings | BModeSettings]:
    """Frames of a file, as many as it has times for."""
    name = next((name for name in SAMPLE_TYPES if name in file), None)
    if name is None:
        raise InvalidInputError(f"{locate(file)}: expected a data set rf, iq or bmode, got none of them")
    where, dtype = locate(file, name), require_dataset(file, name).dtype.newbyteorder("=")
    require_sample_type(name, dtype, where)
    in_pairs = name == "iq" and dtype == np.int16
    shape = _length(file, count), "vector", "sample", *((2,) if in_pairs else ())
    node = require_dataset(file, name, shape)
    vectors, samples = node.shape[1:3]
    slices = HDF5Slices(Path(file.filename).absolute(), (name,), from_pairs if in_pairs else np.asarray)
    with naming(where):
        signal = read_signal(node, name)
        if isinstance(signal, RFSettings):
            pitch, spacing_mm = "vector_pitch_mm", signal.sample_spacing_mm
        else:
            pitch, spacing_mm = "column_pitch_mm", read_attribute(node, "row_spacing_mm")
        grid = read_record(
            node,
            ImageGrid,
            vectors=vectors,
            samples=samples,
            vector_pitch_mm=read_attribute(node, pitch),
            sample_spacing_mm=spacing_mm,
            fan=read_record(require_group(file, "fan"), FanLines) if "fan" in file else None,
        )
    kind = np.complex64 if in_pairs else dtype
    return FileFrames(slices.path, slices, (count, vectors, samples), kind, dtype), grid, signal


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
    if name not in file:
        return None
    group, (readings, mounting, shape, check) = require_group(file, name), SENSORS[name]
    times_s = _times(group)
    count = times_s.size
    valid = _rows(group, "valid", count) != 0 if "valid" in group else np.ones(count, dtype=bool)
    if not valid.any():
        return None
    values = _rows(group, readings, count, *shape)
    # Invalid samples may hold anything; replaced, not dropped, so that indices in messages stay right.
    values[~valid] = np.eye(4)[0] if shape == (4,) else np.eye(4)
    world_from_sensor, place = check(values, locate(group, readings))[valid], None
    if mounting in group.attrs:
        numbers = read_vector_attribute(group, mounting, math.prod(shape))
        place = check(numbers.reshape(1, *shape), f"{locate(group)} attribute {mounting}")[0]
    stream, kind = (TimedPoses, Tracker) if name == "tracker" else (TimedRotations, OrientationSensor)
    with naming(locate(group)):
        vectors = {key: _rows(group, key, count, 3)[valid] for key in INERTIAL if key in group}
        for key, rows in vectors.items():
            require_finite(rows, key)
        samples = stream(times_s[valid], world_from_sensor)
    return read_record(group, kind, readings=samples, sensor_from_image=place, **vectors)


READER = Reader(
    FORMAT, None, open_sweep, claims_hdf5=lambda file: file_format(file) == FORMAT, takes_settings=False
)
