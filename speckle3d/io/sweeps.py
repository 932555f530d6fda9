"""Reading of the sweep file, versions 1 and 2 (with I/Q); frames stay on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.geometry import (
    require_finite,
    require_increasing,
    rotations_from_quaternions,
    transforms_from_matrices,
)
from speckle3d.core.printable import printable
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import (
    INERTIAL,
    BModeSettings,
    ImageGrid,
    OrientationSensor,
    RFSettings,
    Sweep,
    Tracker,
)
from speckle3d.io.hdf5 import (
    PathLike,
    find_group,
    has_format,
    has_member,
    hdf5_claim,
    locate,
    open_hdf5,
    opened,
    read_attribute,
    read_checked,
    read_rows,
    read_text,
    read_transforms,
    read_vector_attribute,
    reading,
    require_dataset,
)
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.lazy import HDF5Slices, Slices
from speckle3d.io.readers import Reader

FORMAT = "speckle3d.sweep"
VERSION, IQ_VERSION = 1, 2
"""Of files without and with I/Q, so that older readers still read what they can make sense of."""

GROWING = "unfinished"
"""Data set of files that grow as they are recorded: 0 once the recording has been closed."""

KNOWN = frozenset({"rf", "iq", "bmode", "frame_time_s", "orientation", "tracker", "truth", GROWING})
"""Members of the root that these versions of the format give a meaning to."""

SAMPLE_TYPES: dict[str, tuple[np.dtype[Any], ...]] = {
    "rf": (np.dtype(np.int16), np.dtype(np.float32)),
    "iq": (np.dtype(np.complex64), np.dtype(np.int16)),
    "bmode": (np.dtype(np.uint8),),
}
"""Types that the samples of each kind may have in the file; int16 of I/Q in pairs, I first."""

RF_NUMBERS = ("sampling_rate_hz", "speed_of_sound_m_s", "centre_frequency_hz")
"""Attributes of /rf that are a number each of `RFSettings`."""


class HDF5Frames(HDF5Slices):
    """Frames of a sweep file, read one at a time; pairs of int16 (I/Q) as complex64."""

    def __init__(
        self, path: PathLike, name: str, shape: tuple[int, ...], dtype: np.dtype[Any], grows: bool = False
    ) -> None:
        in_pairs = len(shape) == 4
        n, vectors, samples = shape[:3]
        turn = complex_of_pairs if in_pairs else as_stored
        kind = np.complex64 if in_pairs else dtype
        super().__init__(path, [name], 0, turn, (n, vectors, samples), kind, grows)
        self.stored_dtype = dtype


def as_stored(slices: Slices) -> npt.NDArray[Any]:
    """Frame as the file has it."""
    return slices[0]


def complex_of_pairs(slices: Slices) -> npt.NDArray[Any]:
    """Frame of I and Q in pairs, the last axis."""
    return from_pairs(slices[0])


def read_sweep(path: PathLike) -> Sweep:
    """Read a sweep file; its frames stay on disk until they are asked for.

    Raises
    ------
    FileError
        If the file is missing, truncated or not HDF5.
    InvalidInputError
        Naming the file, the data set and the first bad index.
    """
    with opened(path, FORMAT, (VERSION, IQ_VERSION)) as file:
        grows = is_growing(file)
        times, n = None, None
        if grows:
            times = read_rows(file, "frame_time_s", ("frame",))
            n = times.size
            if not n:
                raise InvalidInputError(f"{locate(file)}: expected a frame, got none so far")
        frames, grid, signal = _read_image(file, n)
        n = frames.shape[0]
        if times is None:
            times = read_checked(file, "frame_time_s", (n,))
        return Sweep(
            frames=frames,
            grid=grid,
            signal=signal,
            frame_time_s=require_increasing(times, locate(file, "frame_time_s")),
            orientation=_read_orientation(file),
            tracker=_read_tracker(file),
            truth=_read_truth(file, n),
            name=printable(Path(path).stem),
            probe=read_text(file, "probe") if "probe" in file.attrs else "",
        )


def is_growing(file: h5py.File) -> bool:
    """Whether an open file's recording goes on, or has ended without being closed."""
    if file.swmr_mode:
        return True
    return has_member(file, GROWING) and bool(read_checked(file, GROWING, (), np.bool_))


def _read_image(
    file: h5py.File, rows: int | None
) -> tuple[HDF5Frames, ImageGrid, RFSettings | BModeSettings]:
    """Frames of a file; of one that grows, as many as it has times for."""
    name = _name_of_image(file)
    node = require_dataset(file, name, rows)
    where = locate(file, name)
    dtype = node.dtype.newbyteorder("=")
    require_sample_type(name, dtype, where)
    pairs = (2,) if name == "iq" and dtype == np.int16 else ()
    if node.ndim != 3 + len(pairs) or node.shape[3:] != pairs or 0 in node.shape:
        expected = f"(frame, vector, sample{', 2' if pairs else ''})"
        raise InvalidInputError(f"{where}: expected shape {expected}, got {node.shape}")
    shape = node.shape if rows is None else (rows, *node.shape[1:])
    if not shape[0] <= node.shape[0]:
        raise InvalidInputError(f"{where}: expected {rows} frames or more, got {node.shape[0]}")
    frames = HDF5Frames(file.filename, name, shape, dtype, rows is not None)
    with naming(where):
        signal = read_signal(node, name)
        return frames, _read_grid(node, signal), signal


def _name_of_image(file: h5py.File) -> str:
    """Name of the data set that holds the frames."""
    known = ("rf", "bmode") if read_attribute(file, "version") == VERSION else ("rf", "iq", "bmode")
    held = [name for name in known if has_member(file, name)]
    if not held or ("iq" in held and len(held) > 1):
        raise InvalidInputError(
            f"{locate(file)}: expected a data set {', '.join(known[:-1])} or {known[-1]}, got "
            f"{' and '.join(held) or 'none of them'}"
        )
    return held[0]


def from_pairs(pairs: npt.NDArray[np.int16]) -> npt.NDArray[np.complex64]:
    """Complex samples of pairs of I and Q, the last axis."""
    return pairs.astype(np.float32).view(np.complex64)[..., 0]


def require_sample_type(name: str, dtype: np.dtype[Any], where: str) -> None:
    """Raise `InvalidInputError` unless /rf, /iq or /bmode may hold samples of a type."""
    if dtype not in SAMPLE_TYPES[name]:
        expected = " or ".join(str(kind) for kind in SAMPLE_TYPES[name])
        raise InvalidInputError(f"{where}: expected samples of type {expected}, got {dtype}")


def read_signal(node: h5py.Group | h5py.Dataset, kind: str) -> RFSettings | BModeSettings:
    """Read how the samples were made from attributes; `kind` is ``"rf"``, ``"iq"`` or ``"bmode"``."""
    if kind == "bmode":
        dynamic_range_db = read_attribute(node, "dynamic_range_db")
        return BModeSettings(dynamic_range_db, read_attribute(node, "full_scale", default=255.0))
    low, high = read_vector_attribute(node, "bandwidth_hz", 2).tolist()
    numbers = {name: read_attribute(node, name) for name in RF_NUMBERS}
    name = "demodulation_frequency_hz"
    middle = read_attribute(node, name) if kind == "iq" or name in node.attrs else None
    return RFSettings(**numbers, bandwidth_hz=(low, high), demodulation_frequency_hz=middle)


def signal_attributes(signal: RFSettings | BModeSettings) -> dict[str, Any]:
    """Attributes that `read_signal` reads back."""
    return {name: value for name, value in vars(signal).items() if value is not None}


def _read_grid(node: h5py.Dataset, signal: RFSettings | BModeSettings) -> ImageGrid:
    vectors, samples = node.shape[1:3]
    first_mm = read_attribute(node, "first_sample_depth_mm")
    if isinstance(signal, RFSettings):
        pitch_mm, spacing_mm = read_attribute(node, "vector_pitch_mm"), signal.sample_spacing_mm
    else:
        pitch_mm, spacing_mm = (read_attribute(node, name) for name in ("column_pitch_mm", "row_spacing_mm"))
    return ImageGrid(vectors, samples, pitch_mm, spacing_mm, first_mm)


def _read_orientation(file: h5py.File) -> OrientationSensor | None:
    group = find_group(file, "orientation")
    if group is None:
        return None
    time_s = _read_times(group)
    if time_s is None:
        return None
    quaternions = _read_values(group, "quaternion_wxyz", (time_s.size, 4))
    rotations = rotations_from_quaternions(quaternions, locate(group, "quaternion_wxyz"))
    vectors = {name: _read_vectors(group, name, time_s.size) for name in INERTIAL if has_member(group, name)}
    mounting, name = None, "sensor_from_image_wxyz"
    if name in group.attrs:
        wxyz = read_vector_attribute(group, name, 4)
        mounting = rotations_from_quaternions(wxyz[None], f"{locate(group)} attribute {name}")[0]
    offset_s = read_attribute(group, "time_offset_s", default=0.0)
    with naming(locate(group)):
        return OrientationSensor(TimedRotations(time_s, rotations), mounting, offset_s, **vectors)


def _read_times(group: h5py.Group) -> FloatArray | None:
    """Times of a sensor's readings; None of one that sent nothing during a recording."""
    if is_growing(group.file):
        times = read_rows(group, "time_s", ("sample",))
    else:
        times = read_checked(group, "time_s", ("sample",))
    if not times.size and has_member(group.file, GROWING):
        return None
    return require_increasing(times, locate(group, "time_s"))


def _read_values(group: h5py.Group, name: str, shape: tuple[int, ...]) -> FloatArray:
    return (read_rows if is_growing(group.file) else read_checked)(group, name, shape)


def _read_tracker(file: h5py.File) -> Tracker | None:
    group = find_group(file, "tracker")
    if group is None:
        return None
    time_s = _read_times(group)
    if time_s is None:
        return None
    valid = _read_valid(group, time_s.size)
    if not valid.any():
        return None
    matrices = _read_values(group, "world_from_sensor", (time_s.size, 4, 4))
    # Invalid samples may hold anything; replaced, not dropped, so that indices in messages stay right.
    matrices[~valid] = np.eye(4)
    poses = transforms_from_matrices(matrices, locate(group, "world_from_sensor"))
    mounting, name = None, "sensor_from_image"
    if name in group.attrs:
        matrix = read_vector_attribute(group, name, 16).reshape(1, 4, 4)
        mounting = transforms_from_matrices(matrix, f"{locate(group)} attribute {name}")[0]
    offset_s = read_attribute(group, "time_offset_s", default=0.0)
    with naming(locate(group)):
        skew_rad = read_attribute(group, "image_skew_rad", default=0.0)
        return Tracker(TimedPoses(time_s[valid], poses[valid]), mounting, offset_s, skew_rad)


def _read_truth(file: h5py.File, frames: int) -> RigidTransform | None:
    group = find_group(file, "truth")
    return None if group is None else read_transforms(group, "world_from_image", frames)


def _read_vectors(group: h5py.Group, name: str, samples: int) -> FloatArray:
    values = read_checked(group, name, (samples, 3))
    require_finite(values, locate(group, name))
    return values


def _read_valid(group: h5py.Group, samples: int) -> BoolArray:
    if not has_member(group, "valid"):
        return np.ones(samples, dtype=bool)
    valid: BoolArray
    if is_growing(group.file):
        valid = read_rows(group, "valid", (samples,)).astype(np.bool_)
    else:
        valid = read_checked(group, "valid", (samples,), np.bool_)
    if samples and not valid.any() and not has_member(group.file, GROWING):
        raise InvalidInputError(f"{locate(group, 'valid')}: expected a valid sample, got none")
    return valid


def unfinished_note(path: PathLike) -> str | None:
    """Words for a sweep file whose recording goes on or was not closed; None for any other file."""
    if not Path(path).is_file() or not h5py.is_hdf5(path):
        return None
    with reading(path), open_hdf5(path) as file:
        if not has_format(file, FORMAT) or not is_growing(file):
            return None
        times = read_rows(file, "frame_time_s", ("frame",))
    return f"{path}: the recording goes on, or was ended without being closed: {times.size} frames so far"


def _notes(path: Path, _: ImportSettings) -> list[str]:
    note = unfinished_note(path)
    return [] if note is None else [note]


READER = Reader(
    FORMAT,
    hdf5_claim(lambda file: has_format(file, FORMAT)),
    lambda path, _: read_sweep(path),
    notes=_notes,
    takes_settings=False,
)
