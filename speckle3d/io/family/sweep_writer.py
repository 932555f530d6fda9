"""Writing of the sweep file, frame by frame: version 1, or 2 with I/Q; whole, or readable while it grows.

For a file that grows HDF5's single-writer mode orders what is written so that a reader never meets half a
change. A frame is in the file before its time is, and a reading before its time: a reader takes as many of
either as there are times.
"""

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Literal, Self

import h5py
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import AnyArray, FloatArray
from speckle3d.core.errors import FileError, InvalidInputError, Speckle3DError, naming
from speckle3d.core.files import cannot_write
from speckle3d.core.geometry import require_finite
from speckle3d.core.grid import ImageGrid
from speckle3d.core.progress import Progress
from speckle3d.core.sweep import BModeSettings, OrientationSensor, RFSettings, Sweep, Tracker, stored_dtype
from speckle3d.core.threads import ahead
from speckle3d.io.family.records import label, put, put_fields, reserve, trim, written
from speckle3d.io.family.sweeps import (
    FORMAT,
    GROWING,
    MEMBERS,
    SAMPLE_TYPES,
    SENSORS,
    VERSIONS,
    require_sample_type,
)
from speckle3d.io.frames import FileFrames
from speckle3d.io.hdf5 import (
    PathLike,
    atomic_path,
    file_format,
    find_member,
    open_family,
    open_hdf5,
    reading,
    require_target,
)

Compression = Literal["gzip", "lzf"] | None
_GZIP_LEVEL = 1
"""Higher ones take several times as long for echoes and save no more than 2 %."""


def _create_frames(
    file: h5py.File,
    grid: ImageGrid,
    signal: RFSettings | BModeSettings,
    dtype: npt.DTypeLike | None,
    compression: Compression,
) -> h5py.Dataset:
    """Data set ``/rf``, ``/iq`` or ``/bmode`` of a new file, without frames, and what describes them."""
    name, sizes = "bmode", {"column_pitch_mm": grid.vector_pitch_mm, "row_spacing_mm": grid.sample_spacing_mm}
    if isinstance(signal, RFSettings):
        name, sizes = "iq" if signal.are_complex else "rf", {"vector_pitch_mm": grid.vector_pitch_mm}
    kind = np.dtype(dtype or SAMPLE_TYPES[name][0])
    require_sample_type(name, kind, f"/{name}")
    shape = (grid.vectors, grid.samples, *((2,) if name == "iq" and kind == np.int16 else ()))
    node = file.create_dataset(
        name, (0, *shape), kind, maxshape=(None, *shape), chunks=(1, *shape), shuffle=compression is not None,
        compression=_GZIP_LEVEL if compression == "gzip" else compression,
    )  # fmt: skip
    put_fields(node, signal)
    first_mm = {"first_sample_depth_mm": grid.first_sample_depth_mm, "first_vector_mm": grid.first_vector_mm}
    node.attrs.update(sizes | first_mm)
    put(file, "fan", grid.fan)
    file.attrs["version"] = 3 if grid.fan else 2 if name == "iq" else 1
    return node


def _append_frame(node: h5py.Dataset, frame: AnyArray) -> None:
    """Write the next frame, shape (vector, sample), and hand it to the operating system.

    Raises
    ------
    InvalidInputError
        If its shape or type is another, or it holds NaN.
    """
    count, *shape = node.shape
    stored = node.dtype
    kind = np.dtype(np.complex64) if len(shape) > 2 else stored
    if frame.shape != (*shape[:2],) or not np.can_cast(frame.dtype, kind, "same_kind"):
        raise InvalidInputError(
            f"frame {count}: expected {kind}, shape {shape[:2]}, got {frame.dtype}, {frame.shape}"
        )
    if frame.dtype.kind in "fc":
        require_finite(frame, f"frame {count}")
    samples = np.ascontiguousarray(frame, kind)
    if kind != stored:  # pairs of int16, as which they were read
        samples = samples.view(np.float32).reshape(shape).astype(stored)
    reserve(h5py.h5i.get_file_id(node.id), samples.nbytes)
    node.id.set_extent((count + 1, *shape))
    if node.compression is None:
        node.id.write_direct_chunk((count, *(0,) * samples.ndim), samples)
    else:
        node[count] = samples


def write_sweep(
    path: PathLike,
    sweep: Sweep,
    progress: Progress | None = None,
    compression: Compression = None,
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
    compression : {None, "gzip", "lzf"}
        HDF5 filter, with byte shuffling. None is as fast as the disk; gzip saves a third of echoes and takes
        some 16 ms for a frame of 1 MB; lzf saves a fifth in 10 ms.

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
    frames = sweep.frames
    # Frames that are computed when they are read are made on all cores.
    images = (ahead if getattr(frames, "computed", False) else map)(frames.__getitem__, range(len(sweep)))
    with naming(str(path)), written(path, FORMAT) as file:
        node = _create_frames(file, sweep.grid, sweep.signal, stored_dtype(frames), compression)
        for i, frame in enumerate(images):
            _append_frame(node, frame)
            if progress is not None:
                progress(i + 1, len(sweep))
        put(file, "frame_time_s", sweep.frame_time_s)
        for name in SENSORS:
            _put_sensor(file, name, getattr(sweep, name))
        put(file, "truth/world_from_image", sweep.truth)
        put(file, "probe", sweep.probe or None)
        for name, value in (simulation or {}).items():
            plain = value if isinstance(value, str | int | float) else json.dumps(value, sort_keys=True)
            put(file, "simulation", {name: plain})
        if isinstance(frames, FileFrames):
            _copy_others(frames.path, file)


def _copy_others(source: PathLike, file: h5py.File) -> None:
    """Copy what another sweep file holds beyond the format: groups, data sets and attributes of the root."""
    with reading(source), naming(str(source)):
        if not h5py.is_hdf5(source):
            return
        with open_hdf5(source) as origin:
            if file_format(origin) != FORMAT:
                return
            for name in {*origin} - MEMBERS - {*file}:
                origin.copy(find_member(origin, name), file, name)
            for name in {*origin.attrs} - {*file.attrs}:
                file.attrs[name] = origin.attrs[name]


def attach_orientation(path: PathLike, sensor: OrientationSensor) -> None:
    """Put an orientation sensor's stream into a sweep file, in place of the one it may hold.

    A copy of the file is changed and put back in one step, so that it is never half written.

    Raises
    ------
    FileError
        If the file cannot be read or written.
    InvalidInputError
        If it is no sweep file.
    """
    with open_family(path, FORMAT, VERSIONS) as file:
        if file.swmr_mode:
            raise InvalidInputError(
                "expected a recording that was closed: speckle3d convert makes a whole file"
            )
    with atomic_path(path) as part:
        shutil.copyfile(path, part)
        with h5py.File(part, "r+", locking=False) as file:
            if "orientation" in file:
                del file["orientation"]
            _put_sensor(file, "orientation", sensor)
            label(file)
        trim(part)


def _put_sensor(file: h5py.File, name: str, sensor: OrientationSensor | Tracker | None) -> None:
    """Write a sensor's readings and mounting, if there is one."""
    if sensor is None:
        return
    readings, mounting, _, _ = SENSORS[name]
    values = dict(vars(sensor))
    stream, place = values.pop("readings"), values.pop("sensor_from_image")
    # Of rotations, `put` says that they are quaternions, scalar first.
    poses = {readings.removesuffix("_wxyz"): stream.world_from_sensor}
    put(file, name, {**values, "time_s": stream.time_s, **poses})
    if place is not None:
        numbers = place.as_quat(scalar_first=True) if isinstance(place, Rotation) else place.as_matrix()
        file[name].attrs[mounting] = numbers


_STREAMS: dict[str, dict[str, tuple[int, ...]]] = {
    "/": {"frame_time_s": ()},
    **{name: {readings: shape, "time_s": ()} for name, (readings, _, shape, _) in SENSORS.items()},
}
"""Groups whose data sets grow row by row, by the shape of a row. Times last: what has a time is whole."""
_ROWS_PER_CHUNK = 128
"""A chunk is written again with every value that is added to it."""


class GrowingSweep:
    """Write a sweep file frame by frame; what was appended is in it even if the process is killed.

    A block that ends without an error leaves a file as `write_sweep` does; one with an error, a file that
    says that its recording was not closed. Without a frame there is no file.

    Parameters
    ----------
    path : path
        A new file, of this name from the first frame.
    grid : ImageGrid
    signal : RFSettings or BModeSettings
        Decides whether frames become ``/rf``, ``/iq`` or ``/bmode``.
    dtype : dtype, optional
        int16 or float32 for RF, complex64 or int16 (pairs) for I/Q, uint8 for B-mode; by default the first.
    compression : {None, "gzip", "lzf"}
        As for `write_sweep`.
    probe : str
        Name of probe and preset.

    Raises
    ------
    FileError
        If the file is there already or cannot be written.
    InvalidInputError
        If samples cannot be of the type.

    Examples
    --------
    >>> import tempfile
    >>> from speckle3d import load_sweep
    >>> grid = ImageGrid(vectors=8, samples=40, vector_pitch_mm=0.3, sample_spacing_mm=0.1)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with GrowingSweep(f"{folder}/s.h5", grid, BModeSettings(dynamic_range_db=60.0)) as growing:
    ...         growing.append(np.zeros((8, 40), np.uint8), 0.0)
    ...         growing.append(np.ones((8, 40), np.uint8), 0.04)
    ...         so_far = len(load_sweep(f"{folder}/s.h5"))
    >>> so_far
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
    ) -> None:
        self.path = require_target(path)
        if self.path.exists():
            raise FileError(f"{path}: there already; expected a new file")
        with naming(str(path)), self._writing():
            self._file = file = h5py.File(self.path, "x", libver="latest")
            try:
                reserve(file.id)
                put(file, "format", FORMAT)
                put(file, "probe", probe or None)
                self._frames = _create_frames(file, grid, signal, dtype, compression)
                for group, shapes in _STREAMS.items():
                    for name, shape in shapes.items():
                        sizes = {"maxshape": (None, *shape), "chunks": (_ROWS_PER_CHUNK, *shape)}
                        file.create_dataset(f"{group}/{name}", (0, *shape), "f8", fillvalue=np.nan, **sizes)
                file[GROWING] = np.uint8(1)
                label(file)
                file.swmr_mode = True
            except BaseException:
                file.close()
                self.path.unlink(missing_ok=True)
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            with self._writing():
                self._file[GROWING][...] = kind is not None
        finally:
            is_empty = not len(self)
            self._file.close()
            trim(self.path)
            if is_empty:  # no sweep is without frames
                self.path.unlink(missing_ok=True)

    def __len__(self) -> int:
        """Frames in the file."""
        return len(self._frames)

    def append(self, frame: AnyArray, time_s: float) -> None:
        """Write the next frame, shape (vector, sample), taken at image time `time_s`.

        Raises
        ------
        InvalidInputError
            If its shape or type is another, it holds NaN, or its time is not after the one before: it is then
            not in the file, and the next one may come.
        NoSpaceError
            If the disk is full.
        """
        with self._row("/", time_s):
            _append_frame(self._frames, frame)
            self._frames.flush()

    def append_reading(self, sensor: str, time_s: float, reading: FloatArray) -> None:
        """Write world_from_sensor of a sensor.

        Parameters
        ----------
        sensor : {"tracker", "orientation"}
        time_s : float
        reading : ndarray, shape (4, 4) in mm, or (4,), a unit quaternion, scalar first

        Raises
        ------
        InvalidInputError
            If it is not rigid or of unit length, or its time is not after the one before: it is then not in
            the file.
        """
        *_, check = SENSORS[sensor]
        check(np.asarray(reading)[None], f"{self.path}: /{sensor} at {time_s} s")
        with self._row(sensor, time_s, reading):
            pass

    @contextmanager
    def _row(self, group: str, time_s: float, *values: Any) -> Iterator[None]:
        """Write a row of a group after the block, its time last, and hand it to the operating system."""
        nodes = [self._file[group][name] for name in _STREAMS[group]]
        last_s = nodes[-1][-1] if len(nodes[-1]) else -np.inf
        if not last_s < time_s < np.inf:
            raise InvalidInputError(f"{self.path}: {group}: expected a time after {last_s} s, got {time_s}")
        with naming(str(self.path)), self._writing():
            yield
            reserve(self._file.id)
            for node, value in zip(nodes, (*values, time_s), strict=True):
                node.resize(len(node) + 1, axis=0)
                node[-1] = value
                node.id.flush()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except Speckle3DError:
            raise
        except (OSError, RuntimeError) as error:
            failure = error if isinstance(error, OSError) else OSError(str(error))
            raise cannot_write(self.path, failure) from error
