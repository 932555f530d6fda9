"""Writing of the sweep file, frame by frame: version 1, or 2 with I/Q."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Any, Literal, Protocol, runtime_checkable

import h5py
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.geometry import require_finite, require_increasing
from speckle3d.core.parts import DiskFile
from speckle3d.core.progress import Progress
from speckle3d.core.sweep import (
    INERTIAL,
    BModeSettings,
    ImageGrid,
    OrientationSensor,
    RFSettings,
    Sweep,
    Tracker,
    stored_dtype,
)
from speckle3d.io.deflate import DeflatingWriter
from speckle3d.io.hdf5 import HDF5Writer, PathLike, atomic_path, has_member, open_hdf5, opened, reading
from speckle3d.io.hdf5_guard import plain_attribute, require_own
from speckle3d.io.sweeps import (
    FORMAT,
    IQ_VERSION,
    KNOWN,
    SAMPLE_TYPES,
    VERSION,
    HDF5Frames,
    require_sample_type,
    signal_attributes,
)

Compression = Literal["gzip", "lzf"] | None
COMPRESSIONS: dict[str, Compression] = {"gzip": "gzip", "lzf": "lzf", "none": None}
"""By their names on the command line."""


_GZIP_LEVEL = 1
"""Told to readers; what packs is `speckle3d.io.deflate`."""


@runtime_checkable
class CarriesMore(Protocol):
    """Frames of a recording that says more than a sweep holds."""

    def write_more(self, file: h5py.File) -> None:
        """Write that into groups of its own."""


@runtime_checkable
class MadeInOrder(Protocol):
    """Frames that are computed when they are read, and fastest from the first to the last."""

    def in_order(self) -> Iterator[npt.NDArray[Any]]:
        """All frames."""


class SweepWriter(HDF5Writer):
    """Write a sweep file frame by frame; it appears whole when the block ends, or not at all.

    Parameters
    ----------
    path : path
    grid : ImageGrid
    signal : RFSettings or BModeSettings
        Decides whether frames become ``/rf``, ``/iq`` or ``/bmode``.
    dtype : dtype
        int16 or float32 for RF, complex64 or int16 (pairs) for I/Q, uint8 for B-mode; by default the first.
    compression : {"gzip", "lzf", None}
        HDF5 filter, with byte shuffling. gzip packs in threads (see `speckle3d.io.deflate`), lzf does not and
        is both slower and larger; None is as fast as the disk.
    """

    def __init__(
        self,
        path: PathLike,
        grid: ImageGrid,
        signal: RFSettings | BModeSettings,
        dtype: npt.DTypeLike | None = None,
        compression: Compression = "gzip",
    ) -> None:
        self._grid, self._signal = grid, signal
        self._name = name_for(signal)
        super().__init__(path, FORMAT, IQ_VERSION if self._name == "iq" else VERSION)
        self._dtype: np.dtype[Any] = SAMPLE_TYPES[self._name][0] if dtype is None else np.dtype(dtype)
        require_sample_type(self._name, self._dtype, f"{path}: /{self._name}")
        self._paired = self._name == "iq" and self._dtype == np.int16
        self._compression = compression
        self._deflating: DeflatingWriter | None = None
        self._time_s: list[float] = []

    def _begin(self) -> None:
        shape = (self._grid.vectors, self._grid.samples, *((2,) if self._paired else ()))
        node = self._file.create_dataset(
            self._name,
            shape=(0, *shape),
            maxshape=(None, *shape),
            chunks=(1, *shape),
            dtype=self._dtype,
            compression=self._compression,
            compression_opts=_GZIP_LEVEL if self._compression == "gzip" else None,
            shuffle=self._compression is not None,
        )
        node.attrs.update(frames_attributes(self._grid, self._signal))
        self._frames = node.id
        self._in_memory = h5py.h5s.create_simple(shape)
        self._kind = h5py.h5t.py_create(self._dtype)
        if self._compression == "gzip":
            self._deflating = DeflatingWriter(self._frames, self._require_room)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            super().__exit__(kind, error, trace)
        finally:
            if self._deflating is not None:
                self._deflating.close()

    def append(self, frame: npt.NDArray[Any], time_s: float) -> None:
        """Write the next frame, shape (vector, sample), taken at image time `time_s`.

        Raises
        ------
        InvalidInputError
            If its shape or type is another, it holds NaN, or its time is not after the one before.
        """
        i = len(self._time_s)
        where = f"{self._path}: /{self._name}[{i}]"
        stored = frame_for(self._name, frame, self._grid, self._dtype, where)
        self._write(i, stored)
        if self._deflating is None:
            self._require_room()
        self._time_s.append(float(time_s))

    def write_sensor(self, sensor: OrientationSensor | Tracker) -> None:
        """Write a sensor's stream."""
        _write_sensor(self._file, sensor)

    def write_truth(self, world_from_image: RigidTransform) -> None:
        """Write the true pose of every frame."""
        self._file["truth/world_from_image"] = world_from_image.as_matrix()

    def write_probe(self, name: str) -> None:
        """Write the name of probe and preset."""
        self._file.attrs["probe"] = name

    def write_simulation(self, values: Mapping[str, Any]) -> None:
        """Write how a sweep was simulated as attributes of ``/simulation``; nested values become JSON."""
        group = self._file.require_group("simulation")
        for name, value in values.items():
            plain = isinstance(value, str | int | float)
            group.attrs[name] = value if plain else json.dumps(value, sort_keys=True)

    def write_more(self, frames: CarriesMore) -> None:
        """Write what frames carry beyond the format."""
        frames.write_more(self._file)

    def copy_unknown(self, source: PathLike) -> None:
        """Copy what another sweep file holds beyond this version of the format."""
        with reading(source), naming(str(source)), open_hdf5(source) as other:
            for name in other:
                if name not in KNOWN and name not in self._file:
                    other.copy(require_own(other, name), self._file, name)
            for name in other.attrs:
                if name not in self._file.attrs:
                    self._file.attrs[name] = plain_attribute(other, name)

    def _write(self, i: int, frame: npt.NDArray[Any]) -> None:
        if self._deflating is not None:
            self._deflating.append(frame)
            return
        self._frames.set_extent((i + 1, *frame.shape))
        on_disk = self._frames.get_space()
        on_disk.select_hyperslab((i, *(0,) * frame.ndim), (1, *frame.shape))
        self._frames.write(self._in_memory, on_disk, frame, self._kind)
        # Kept until the next frame, so that a Ctrl-C pressed meanwhile is not lost (as in HDF5Frames).
        self._on_disk = on_disk

    def _finish(self) -> None:
        if self._deflating is not None:
            self._deflating.finish()
        with naming(str(self._path)):
            times = require_increasing(np.asarray(self._time_s, dtype=float), "/frame_time_s")
            if times.size == 0:
                raise InvalidInputError(f"/{self._name}: expected at least one frame, got none")
            truth = self._file.get("truth/world_from_image")
            if truth is not None and len(truth) != times.size:
                raise InvalidInputError(f"/truth: expected {times.size} poses, got {len(truth)}")
        self._file["frame_time_s"] = times


def write_sweep(
    path: PathLike,
    sweep: Sweep,
    progress: Progress | None = None,
    compression: Compression = "gzip",
    simulation: Mapping[str, Any] | None = None,
) -> None:
    """Write a sweep; what its own file holds beyond the format is copied along.

    Parameters
    ----------
    progress : callable, optional
        Called with the number of frames written and their total.
    simulation : mapping, optional
        How the sweep was simulated, for ``/simulation``.
    path : path
        HDF5 file to write.
    sweep : Sweep
    compression : {"gzip", "lzf", None}
        As of `SweepWriter`.

    Raises
    ------
    InvalidInputError
        If the samples are of a type the format does not hold, as float64.

    Examples
    --------
    >>> import tempfile
    >>> import speckle3d
    >>> grid = ImageGrid(vectors=8, samples=40, vector_pitch_mm=0.3, sample_spacing_mm=0.1)
    >>> frames = np.zeros((3, 8, 40), dtype=np.uint8)
    >>> sweep = Sweep(frames, grid, BModeSettings(dynamic_range_db=60.0), np.arange(3) / 25)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_sweep(f"{folder}/sweep.h5", sweep)
    ...     len(speckle3d.load_sweep(f"{folder}/sweep.h5"))
    3
    """
    with SweepWriter(path, sweep.grid, sweep.signal, stored_dtype(sweep.frames), compression) as writer:
        frames = sweep.frames
        made = (
            frames.in_order()
            if isinstance(frames, MadeInOrder)
            else map(frames.__getitem__, range(len(sweep)))
        )
        for i, (frame, time_s) in enumerate(zip(made, sweep.frame_time_s, strict=True)):
            writer.append(frame, time_s)
            if progress is not None:
                progress(i + 1, len(sweep))
        for sensor in (sweep.orientation, sweep.tracker):
            if sensor is not None:
                writer.write_sensor(sensor)
        if sweep.truth is not None:
            writer.write_truth(sweep.truth)
        if sweep.probe:
            writer.write_probe(sweep.probe)
        if simulation is not None:
            writer.write_simulation(simulation)
        if isinstance(sweep.frames, CarriesMore):
            writer.write_more(sweep.frames)
        if type(sweep.frames) is HDF5Frames:
            writer.copy_unknown(sweep.frames.path)


def attach_orientation(path: PathLike, sensor: OrientationSensor) -> None:
    """Put an orientation sensor's stream into a sweep file, in place of the one it may hold.

    The file is copied, changed and put back in one step, so that it is never half written.

    Raises
    ------
    FileError
        If the file cannot be read or written.
    InvalidInputError
        If it is no sweep file.
    """
    with opened(path, FORMAT, (VERSION, IQ_VERSION)) as file:
        held = has_member(file, "orientation")
    with atomic_path(path) as part:
        shutil.copyfile(path, part)
        with DiskFile(part, keep=True) as disk, h5py.File(disk, "r+") as file:
            if held:
                del file["orientation"]
            _write_sensor(file, sensor)


def _write_sensor(file: h5py.File, sensor: OrientationSensor | Tracker) -> None:
    group = file.create_group("tracker" if isinstance(sensor, Tracker) else "orientation")
    group["time_s"] = sensor.readings.time_s
    group.attrs["time_offset_s"] = sensor.time_offset_s
    if isinstance(sensor, Tracker):
        group["world_from_sensor"] = sensor.readings.world_from_sensor.as_matrix()
        group["valid"] = np.ones(len(sensor.readings), dtype=bool)
        if sensor.sensor_from_image is not None:
            group.attrs["sensor_from_image"] = sensor.sensor_from_image.as_matrix()
        if sensor.image_skew_rad:
            group.attrs["image_skew_rad"] = sensor.image_skew_rad
        return
    group["quaternion_wxyz"] = sensor.readings.world_from_sensor.as_quat(scalar_first=True)
    for name in INERTIAL:
        if (values := getattr(sensor, name)) is not None:
            group[name] = np.asarray(values, dtype=np.float64)
    if sensor.sensor_from_image is not None:
        group.attrs["sensor_from_image_wxyz"] = sensor.sensor_from_image.as_quat(scalar_first=True)


def frame_for(
    name: str, frame: npt.NDArray[Any], grid: ImageGrid, dtype: np.dtype[Any], where: str
) -> npt.NDArray[Any]:
    """Frame, shape (vector, sample), as /rf, /iq or /bmode store it: contiguous, I/Q of int16 in pairs.

    Raises
    ------
    InvalidInputError
        If its shape or type is another, or it holds NaN.
    """
    expected = (grid.vectors, grid.samples)
    if frame.shape != expected:
        raise InvalidInputError(f"{where}: expected a frame of shape {expected}, got {frame.shape}")
    wanted: np.dtype[Any] = np.dtype(np.complex64) if name == "iq" else dtype
    if not np.can_cast(frame.dtype, wanted, "same_kind") or (name == "iq" and frame.dtype.kind != "c"):
        raise InvalidInputError(f"{where}: expected samples of type {wanted}, got {frame.dtype}")
    if frame.dtype.kind in "fc":
        require_finite(frame, where)
    if name == "iq" and dtype == np.int16:
        frame = _as_pairs(frame, where)
    return np.ascontiguousarray(frame, dtype)


def name_for(signal: RFSettings | BModeSettings) -> str:
    """Name of the data set of frames of a kind."""
    if not isinstance(signal, RFSettings):
        return "bmode"
    return "iq" if signal.are_complex else "rf"


def _as_pairs(frame: npt.NDArray[Any], where: str) -> npt.NDArray[np.int16]:
    """Make pairs of int16, shape (vector, sample, 2), of I/Q whose parts are such numbers.

    Raises
    ------
    InvalidInputError
        If some are not whole, or are out of range.
    """
    parts = np.ascontiguousarray(frame, dtype=np.complex64).view(np.float32).reshape(*frame.shape, 2)
    limits = np.iinfo(np.int16)
    if float(parts.min()) >= limits.min and float(parts.max()) <= limits.max:
        pairs = parts.astype(np.int16)
        if np.array_equal(pairs, parts):
            return pairs
    raise InvalidInputError(
        f"{where}: expected I and Q that are whole numbers from {limits.min} to {limits.max}, got others"
    )


def frames_attributes(grid: ImageGrid, signal: RFSettings | BModeSettings) -> dict[str, Any]:
    """Attributes of the data set of frames."""
    held = signal_attributes(signal) | {"first_sample_depth_mm": grid.first_sample_depth_mm}
    if isinstance(signal, RFSettings):
        band = np.asarray(signal.bandwidth_hz, dtype=float)
        return held | {"vector_pitch_mm": grid.vector_pitch_mm, "bandwidth_hz": band}
    return held | {"column_pitch_mm": grid.vector_pitch_mm, "row_spacing_mm": grid.sample_spacing_mm}
