"""Reading of the sweep file, versions 1 and 2 (with I/Q); frames stay on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import FloatArray
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
    file_format,
    has_member,
    locate,
    opened,
    read_attribute,
    read_checked,
    read_text,
    read_transforms,
    read_vector_attribute,
    require_dataset,
    require_group,
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

KNOWN = frozenset({"rf", "iq", "bmode", "frame_time_s", "orientation", "tracker", "truth", "fan", GROWING})
"""Members of the root that these versions of the format give a meaning to."""

SAMPLE_TYPES: dict[str, tuple[np.dtype[Any], ...]] = {
    "rf": (np.dtype(np.int16), np.dtype(np.float32)),
    "iq": (np.dtype(np.complex64), np.dtype(np.int16)),
    "bmode": (np.dtype(np.uint8),),
}
"""Types that the samples of each kind may have in the file; int16 of I/Q in pairs, I first."""

SIGNALS: dict[str, type[RFSettings] | type[BModeSettings]] = {
    "rf": RFSettings,
    "iq": RFSettings,
    "bmode": BModeSettings,
}
"""What tells how the samples of each kind were made."""


class SweepSlices(HDF5Slices):
    """Opens the frames of a sweep file."""


def from_pairs(pairs: npt.NDArray[np.int16]) -> npt.NDArray[np.complex64]:
    """Complex samples of pairs of I and Q, the last axis."""
    return pairs.astype(np.float32).view(np.complex64)[..., 0]


def _open(path: Path, _: ImportSettings) -> Recording:
    """Read a sweep file; its frames stay on disk until they are asked for."""
    with opened(path, FORMAT, (VERSION, IQ_VERSION, FAN_VERSION)) as file:
        times = _read_times(file, "frame_time_s")
        if not times.size:
            raise InvalidInputError(f"{locate(file)}: expected a frame, got none so far")
        frames, grid, signal = _read_image(file, times.size)
        truth = require_group(file, "truth") if has_member(file, "truth") else None
        sweep = Sweep(
            frames=frames,
            grid=grid,
            signal=signal,
            frame_time_s=times,
            orientation=_read_orientation(file),
            tracker=_read_tracker(file),
            truth=None if truth is None else read_transforms(truth, "world_from_image", times.size),
            name=printable(path.stem),
            probe=read_text(file, "probe") if "probe" in file.attrs else "",
        )
        if not _is_growing(file):
            return Recording(path, ready=sweep)
    words = "goes on, or was ended without being closed"
    note = (
        f"{path}: the recording {words}: {times.size} frames so far, of which speckle3d convert makes a "
        "whole file"
    )
    return Recording(path, ready=sweep, rows=(("recording", words, ""),), remarks=(note,))


def _is_growing(file: h5py.File) -> bool:
    """Whether an open file's recording goes on, or has ended without being closed."""
    return file.swmr_mode or (has_member(file, GROWING) and bool(read_checked(file, GROWING, (), np.bool_)))


def _read_times(group: h5py.Group, name: str = "time_s") -> FloatArray:
    """Read times that increase; of a file that grows those before NaN, as many as there are whole rows."""
    times = read_checked(group, name, ("row",))
    if _is_growing(group.file) and np.isnan(times).any():
        times = times[: np.argmax(np.isnan(times))]
    return require_increasing(times, locate(group, name))


def _read_rows(
    group: h5py.Group, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike = np.float64
) -> npt.NDArray[Any]:
    """Read a data set of a shape; a file that grows may have more rows, which are left out."""
    is_growing = _is_growing(group.file)
    return read_checked(group, name, ("row", *shape[1:]) if is_growing else shape, dtype)[: shape[0]]


def _read_image(file: h5py.File, count: int) -> tuple[FileFrames, ImageGrid, RFSettings | BModeSettings]:
    """Frames of a file, as many as it has times for."""
    name = next((name for name in SIGNALS if has_member(file, name)), None)
    if name is None:
        raise InvalidInputError(f"{locate(file)}: expected a data set rf, iq or bmode, got none of them")
    node, where = require_dataset(file, name), locate(file, name)
    dtype, is_growing = node.dtype.newbyteorder("="), _is_growing(file)
    require_sample_type(name, dtype, where)
    in_pairs = name == "iq" and dtype == np.int16
    is_shaped = node.ndim == 3 + in_pairs and node.shape[3:] in ((), (2,)) and 0 not in node.shape
    if not is_shaped or node.shape[0] < count or (node.shape[0] > count and not is_growing):
        expected = f"({count}, vector, sample{', 2' if in_pairs else ''})"
        raise InvalidInputError(f"{where}: expected shape {expected}, one frame a time, got {node.shape}")
    vectors, samples = node.shape[1:3]
    slices = SweepSlices(Path(file.filename).absolute(), (name,), from_pairs if in_pairs else np.asarray)
    kind = np.complex64 if in_pairs else dtype
    frames = slices.frames((count, vectors, samples), kind, stored_dtype=dtype)
    with naming(where):
        if name == "iq":
            read_attribute(node, "demodulation_frequency_hz")
        signal: RFSettings | BModeSettings = read_record(node, SIGNALS[name])
        first_mm = read_attribute(node, "first_sample_depth_mm")
        if isinstance(signal, RFSettings):
            sizes = read_attribute(node, "vector_pitch_mm"), signal.sample_spacing_mm
        else:
            sizes = read_attribute(node, "column_pitch_mm"), read_attribute(node, "row_spacing_mm")
        fan = read_record(require_group(file, "fan"), FanLines) if has_member(file, "fan") else None
        return frames, ImageGrid(vectors, samples, *sizes, first_mm, fan=fan), signal


def require_sample_type(name: str, dtype: np.dtype[Any], where: str) -> None:
    """Raise `InvalidInputError` unless /rf, /iq or /bmode may hold samples of a type."""
    if dtype not in SAMPLE_TYPES[name]:
        expected = " or ".join(str(kind) for kind in SAMPLE_TYPES[name])
        raise InvalidInputError(f"{where}: expected samples of type {expected}, got {dtype}")


def _read_orientation(file: h5py.File) -> OrientationSensor | None:
    group = require_group(file, "orientation") if has_member(file, "orientation") else None
    if group is None or not (time_s := _read_times(group)).size:
        return None
    quaternions = _read_rows(group, "quaternion_wxyz", (time_s.size, 4))
    rotations = rotations_from_quaternions(quaternions, locate(group, "quaternion_wxyz"))
    vectors = {
        name: _read_rows(group, name, (time_s.size, 3)) for name in INERTIAL if has_member(group, name)
    }
    for vector, values in vectors.items():
        require_finite(values, locate(group, vector))
    mounting, name = None, "sensor_from_image_wxyz"
    if name in group.attrs:
        wxyz = read_vector_attribute(group, name, 4)
        mounting = rotations_from_quaternions(wxyz[None], f"{locate(group)} attribute {name}")[0]
    offset_s = read_attribute(group, "time_offset_s", default=0.0)
    with naming(locate(group)):
        return OrientationSensor(TimedRotations(time_s, rotations), mounting, offset_s, **vectors)


def _read_tracker(file: h5py.File) -> Tracker | None:
    if not has_member(file, "tracker"):
        return None
    group = require_group(file, "tracker")
    time_s = _read_times(group)
    valid = np.ones(time_s.size, dtype=bool)
    if has_member(group, "valid"):
        valid = _read_rows(group, "valid", (time_s.size,), np.bool_)
    if not valid.any():
        return None
    matrices = _read_rows(group, "world_from_sensor", (time_s.size, 4, 4))
    # Invalid samples may hold anything; replaced, not dropped, so that indices in messages stay right.
    matrices[~valid] = np.eye(4)
    poses = transforms_from_matrices(matrices, locate(group, "world_from_sensor"))
    mounting, name = None, "sensor_from_image"
    if name in group.attrs:
        matrix = read_vector_attribute(group, name, 16).reshape(1, 4, 4)
        mounting = transforms_from_matrices(matrix, f"{locate(group)} attribute {name}")[0]
    offset_s, skew_rad = (read_attribute(group, name, 0.0) for name in ("time_offset_s", "image_skew_rad"))
    with naming(locate(group)):
        return Tracker(TimedPoses(time_s[valid], poses[valid]), mounting, offset_s, skew_rad)


READER = Reader(
    FORMAT, None, _open, claims_hdf5=lambda file: file_format(file) == FORMAT, takes_settings=False
)
