"""A sweep file that grows frame by frame and can be read at any moment, also after its writer was killed.

HDF5's single-writer mode orders what is written so that a reader never meets half a change. A frame is in the
file before its time is, and a reading before its time: a reader takes as many of either as there are times.
"""

from __future__ import annotations

import os
import struct
import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.geometry import rotations_from_quaternions, transforms_from_matrices
from speckle3d.core.parts import cannot_write
from speckle3d.core.sweep import BModeSettings, ImageGrid, RFSettings
from speckle3d.io.deflate import deflated, shuffled
from speckle3d.io.hdf5 import PathLike, require_target
from speckle3d.io.meanings import label
from speckle3d.io.sweep_writer import Compression, frame_for, frames_attributes, name_for
from speckle3d.io.sweeps import FORMAT, GROWING, IQ_VERSION, SAMPLE_TYPES, VERSION, require_sample_type

_GZIP_LEVEL = 1
_TIMES_PER_CHUNK = 1024
_READINGS_PER_CHUNK = 128
"""A chunk is written again with every value that is added to it."""
_AHEAD_BYTES, _SPARE_BYTES = 16 * 2**20, 2**20
"""Room on the disk that is taken before it is needed, and the least of it that is left after a frame: HDF5
cannot end a file that it cannot write."""
_EOF_AT = 28
"""Of the file's length in a superblock of version 3."""

_FLUSH_S = 0.2
"""Longest time for which readings wait for the next frame."""

_MOST_WAITING = 4096
"""Readings."""


class GrowingSweep:
    """Write a sweep file frame by frame; what was appended is in it even if the process is killed.

    A block that ends without an error leaves a file as `SweepWriter` does; one with an error, a file that
    says that its recording was not closed. Without a frame there is no file.

    Parameters
    ----------
    path : path
        A new file.
    grid : ImageGrid
    signal : RFSettings or BModeSettings
        Decides whether frames become ``/rf``, ``/iq`` or ``/bmode``.
    dtype : dtype, optional
        As for `SweepWriter`.
    compression : {None, "gzip"}
        gzip takes 12 ms for a frame of 127 x 3818 samples of RF and saves a third.
    probe : str
        Name of probe and preset.
    sensor_from_image : RigidTransform or Rotation, optional
        Calibration of the tracker or the orientation sensor.
    time_offset_s : float
        Added to the times of the sensor's readings, they are image times.

    Raises
    ------
    FileError
        If the file is there already or cannot be written.
    InvalidInputError
        If samples cannot be of the type, or the compression is another.

    Examples
    --------
    >>> import tempfile
    >>> from speckle3d import load_sweep
    >>> grid = ImageGrid(vectors=8, samples=40, vector_pitch_mm=0.3, sample_spacing_mm=0.1)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with GrowingSweep(f"{folder}/s.h5", grid, BModeSettings(dynamic_range_db=60.0)) as growing:
    ...         growing.append(np.zeros((8, 40), np.uint8), 0.0)
    ...         growing.append(np.ones((8, 40), np.uint8), 0.04)
    ...         seen = len(load_sweep(f"{folder}/s.h5"))
    >>> seen
    2
    """

    def __init__(
        self,
        path: PathLike,
        grid: ImageGrid,
        signal: RFSettings | BModeSettings,
        dtype: npt.DTypeLike | None = None,
        compression: Compression = None,
        *,
        probe: str = "",
        sensor_from_image: RigidTransform | Rotation | None = None,
        time_offset_s: float = 0.0,
    ) -> None:
        self.path = Path(path)
        self._grid, self._signal = grid, signal
        self._name = name_for(signal)
        self._dtype: np.dtype[Any] = SAMPLE_TYPES[self._name][0] if dtype is None else np.dtype(dtype)
        require_sample_type(self._name, self._dtype, f"{path}: /{self._name}")
        if compression not in (None, "gzip"):
            raise InvalidInputError(f"{path}: expected no compression or gzip, got {compression}")
        self._compression: Compression = compression
        self._probe, self._mounting, self._offset_s = probe, sensor_from_image, time_offset_s
        self._time_s = -np.inf
        self._count = 0

    def __enter__(self) -> Self:
        target = require_target(self.path)
        try:
            # Made here, so that a file that is there is never opened.
            os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        except FileExistsError as error:
            raise FileError(f"{self.path}: there already; expected a new file") from error
        except OSError as error:
            raise cannot_write(self.path, error) from error
        try:
            with ExitStack() as undo:
                undo.callback(target.unlink, missing_ok=True)
                self._room = undo.enter_context(_Room(target))
                self._file = undo.enter_context(h5py.File(target, "w", libver="latest"))
                self._room.reserve(_AHEAD_BYTES)
                self._begin()
                self._file.swmr_mode = True
                undo.pop_all()
        except OSError as error:
            raise cannot_write(self.path, error) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(complete=kind is None)

    def __len__(self) -> int:
        """Frames in the file."""
        return self._count

    def append(self, frame: npt.NDArray[Any], time_s: float) -> None:
        """Write the next frame, shape (vector, sample), taken at image time `time_s`.

        Raises
        ------
        InvalidInputError
            If its shape or type is another, it holds NaN, or its time is not after the one before: it is then
            not in the file, and the next one may come.
        NoSpaceError
            If the disk is full.
        """
        where = f"{self.path}: /{self._name}[{self._count}]"
        stored = frame_for(self._name, frame, self._grid, self._dtype, where)
        if not (np.isfinite(time_s) and time_s > self._time_s):
            raise InvalidInputError(f"{where}: expected a time after {self._time_s} s, got {time_s}")
        self._write_readings(stored.nbytes)
        i, shape = self._count, stored.shape
        packed = deflated(shuffled(stored)) if self._compression else stored
        try:
            self._frames.set_extent((i + 1, *shape))
            self._frames.write_direct_chunk((i, *(0,) * len(shape)), packed)
            self._frames.flush()
            self._times.append(np.array([time_s]))
        except OSError as error:
            raise cannot_write(self.path, error) from error
        self._time_s, self._count = time_s, i + 1

    def append_pose(self, time_s: float, matrix: npt.ArrayLike, valid: bool = True) -> None:
        """Write a tracker's reading: world_from_sensor, shape (4, 4), mm; of an invalid one any numbers.

        Raises
        ------
        InvalidInputError
            If a valid one is not rigid, or its time is not after the one before: it is then not in the file.
        """
        if valid:
            transforms_from_matrices(np.asarray(matrix)[None], f"{self.path}: /tracker at {time_s} s")
        self._tracker.add(time_s, matrix, valid)
        self._flush_in_time()

    def append_orientation(self, time_s: float, quaternion_wxyz: npt.ArrayLike) -> None:
        """Write an orientation sensor's reading: world_from_sensor, scalar first.

        Raises
        ------
        InvalidInputError
            If it is no unit quaternion, or its time is not after the one before: it is then not in the file.
        """
        where = f"{self.path}: /orientation at {time_s} s"
        rotations_from_quaternions(np.asarray(quaternion_wxyz)[None], where)
        self._orientation.add(time_s, quaternion_wxyz)
        self._flush_in_time()

    def close(self, complete: bool = True) -> None:
        """Write what waits and end the file; closing twice does nothing."""
        if not self._file:
            return
        try:
            self._write_readings()
            self._growing[...] = 0 if complete else 1
        except (OSError, RuntimeError) as error:
            if complete:
                raise cannot_write(self.path, OSError(str(error))) from error
        finally:
            self._file.close()
            self._room.close()
            if not self._count:  # no sweep is without frames
                self.path.unlink(missing_ok=True)

    def _begin(self) -> None:
        file = self._file
        file.attrs["format"] = FORMAT
        file.attrs["version"] = IQ_VERSION if self._name == "iq" else VERSION
        if self._probe:
            file.attrs["probe"] = self._probe
        pair = (2,) if self._name == "iq" and self._dtype == np.int16 else ()
        shape = (self._grid.vectors, self._grid.samples, *pair)
        node = file.create_dataset(
            self._name,
            shape=(0, *shape),
            maxshape=(None, *shape),
            chunks=(1, *shape),
            dtype=self._dtype,
            compression=self._compression,
            compression_opts=_GZIP_LEVEL if self._compression else None,
            shuffle=self._compression is not None,
        )
        node.attrs.update(frames_attributes(self._grid, self._signal))
        self._frames = node.id
        self._times = _Column(file, "frame_time_s", (), _TIMES_PER_CHUNK)
        self._tracker = _Stream(file, "tracker", {"world_from_sensor": (4, 4)}, with_valid=True)
        self._orientation = _Stream(file, "orientation", {"quaternion_wxyz": (4,)})
        for stream in (self._tracker, self._orientation):
            stream.group.attrs["time_offset_s"] = self._offset_s
        if isinstance(self._mounting, RigidTransform):
            self._tracker.group.attrs["sensor_from_image"] = self._mounting.as_matrix()
        elif self._mounting is not None:
            wxyz = self._mounting.as_quat(scalar_first=True)
            self._orientation.group.attrs["sensor_from_image_wxyz"] = wxyz
        self._growing = file.create_dataset(GROWING, data=np.uint8(1))
        label(file)

    def _write_readings(self, frame_bytes: int = 0) -> None:
        """Write readings that wait, once there is room for them and for the next frame."""
        try:
            self._room.reserve(self._file.id.get_filesize() + frame_bytes + _SPARE_BYTES)
            for stream in (self._tracker, self._orientation):
                stream.write()
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def _flush_in_time(self) -> None:
        if any(stream.is_due for stream in (self._tracker, self._orientation)):
            self._write_readings()


class _Room:
    """Room on the disk behind what HDF5 has written, so that a full disk is an error before HDF5 meets it.

    HDF5 cannot close a file whose last bytes it cannot write: what was recorded would be lost. Without
    ``posix_fallocate``, as on Windows, nothing is reserved.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._reserved = path, 0
        self._file = os.open(path, os.O_RDWR)
        self.reserve(_AHEAD_BYTES)
        self._reserved = 0  # HDF5 begins by emptying the file

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def reserve(self, stop: int) -> None:
        """Take room up to a byte of the file, and some more; raises `OSError` if there is none."""
        if stop > self._reserved and hasattr(os, "posix_fallocate"):
            ahead = stop + _AHEAD_BYTES
            os.posix_fallocate(self._file, self._reserved, ahead - self._reserved)
            self._reserved = ahead

    def close(self) -> None:
        """Give back what was not needed of a closed file."""
        length = struct.unpack("<Q", os.pread(self._file, 8, _EOF_AT))[0]
        if 0 < length < os.fstat(self._file).st_size:
            os.ftruncate(self._file, length)
        os.close(self._file)


class _Column:
    """A data set that grows along its first axis."""

    def __init__(self, group: h5py.Group, name: str, shape: tuple[int, ...], chunk: int, dtype: str = "f8"):
        self._node = group.create_dataset(
            name,
            shape=(0, *shape),
            maxshape=(None, *shape),
            chunks=(chunk, *shape),
            dtype=dtype,
            fillvalue=None if dtype == "?" else np.nan,
        )
        self._count = 0

    def append(self, values: npt.NDArray[Any]) -> None:
        """Write values and hand them to the operating system."""
        first, self._count = self._count, self._count + len(values)
        self._node.resize(self._count, axis=0)
        self._node[first:] = values
        self._node.id.flush()


class _Stream:
    """A sensor's readings; they wait for the next frame or a moment, then are written, times last."""

    def __init__(
        self, file: h5py.File, name: str, shapes: dict[str, tuple[int, ...]], with_valid: bool = False
    ) -> None:
        self.group = file.create_group(name)
        self._where = f"{file.filename}: /{name}"
        self._columns = [
            _Column(self.group, key, shape, _READINGS_PER_CHUNK) for key, shape in shapes.items()
        ]
        self._shape = next(iter(shapes.values()))
        if with_valid:
            self._columns.append(_Column(self.group, "valid", (), _READINGS_PER_CHUNK, "?"))
        self._columns.append(_Column(self.group, "time_s", (), _READINGS_PER_CHUNK))
        self._waiting: list[tuple[npt.NDArray[Any] | bool | float, ...]] = []
        self._time_s, self._first_s = -np.inf, 0.0

    def add(self, time_s: float, value: npt.ArrayLike, *valid: bool) -> None:
        """Take a reading."""
        read = np.asarray(value, dtype=np.float64)
        if read.shape != self._shape or not np.isfinite(read).all():
            raise InvalidInputError(
                f"{self._where}: expected finite numbers of shape {self._shape} at {time_s} s, "
                f"got {read.tolist()}"
            )
        if not (np.isfinite(time_s) and time_s > self._time_s):
            raise InvalidInputError(f"{self._where}: expected a time after {self._time_s} s, got {time_s}")
        if not self._waiting:
            self._first_s = time.monotonic()
        self._waiting.append((read, *valid, time_s))
        self._time_s = time_s

    @property
    def is_due(self) -> bool:
        """Whether readings have waited long enough."""
        late = bool(self._waiting) and time.monotonic() - self._first_s > _FLUSH_S
        return late or len(self._waiting) >= _MOST_WAITING

    def write(self) -> None:
        """Write what waits."""
        if self._waiting:
            for column, values in zip(self._columns, zip(*self._waiting, strict=True), strict=True):
                column.append(np.array(values))
            self._waiting = []
