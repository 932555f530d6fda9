"""A sweep file that grows frame by frame and can be read at any moment, also after its writer was killed.

HDF5's single-writer mode orders what is written so that a reader never meets half a change. A frame is in the
file before its time is, and a reading before its time: a reader takes as many of either as there are times.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import FileError, InvalidInputError, Speckle3DError
from speckle3d.core.geometry import rotations_from_quaternions, transforms_from_matrices
from speckle3d.core.parts import cannot_write
from speckle3d.core.sweep import BModeSettings, ImageGrid, RFSettings
from speckle3d.io.hdf5 import PathLike, require_target
from speckle3d.io.meanings import label
from speckle3d.io.records import reserve, trim
from speckle3d.io.sweep_writer import Compression, FrameSet, mounting_attribute
from speckle3d.io.sweeps import FORMAT, GROWING

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
    compression : {None, "gzip", "lzf"}
        As for `FrameSet`.
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
        sensor_from_image: RigidTransform | Rotation | None = None,
        time_offset_s: float = 0.0,
    ) -> None:
        self.path = Path(path)
        self._frames = FrameSet(path, grid, signal, dtype, compression)
        self._probe, self._mounting, self._offset_s = probe, sensor_from_image, time_offset_s
        self._file: h5py.File | None = None

    def __enter__(self) -> Self:
        target = require_target(self.path)
        with self._writing():
            try:
                # Made here, so that a file that is there is never opened.
                os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            except FileExistsError as error:
                raise FileError(f"{self.path}: there already; expected a new file") from error
            try:
                file = h5py.File(target, "w", libver="latest")
                with ExitStack() as undo:
                    undo.callback(file.close)
                    reserve(file.id)
                    self._begin(file)
                    file.swmr_mode = True
                    undo.pop_all()
            except BaseException:
                target.unlink(missing_ok=True)
                raise
            self._file = file
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(complete=kind is None)

    def __len__(self) -> int:
        """Frames in the file."""
        return self._frames.count

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
        self._clock.require_after(time_s)
        with self._writing():
            self._frames.append(frame)
            self._frames.flush()
            self._clock.append(time_s)

    def append_pose(self, time_s: float, matrix: npt.ArrayLike, valid: bool = True) -> None:
        """Write a tracker's reading: world_from_sensor, shape (4, 4), mm; of an invalid one any numbers.

        Raises
        ------
        InvalidInputError
            If a valid one is not rigid, or its time is not after the one before: it is then not in the file.
        """
        pose = np.asarray(matrix if valid else np.eye(4))
        transforms_from_matrices(pose[None], f"{self.path}: /tracker at {time_s} s")
        with self._writing():
            self._tracker.append(pose, valid, time_s)

    def append_orientation(self, time_s: float, quaternion_wxyz: npt.ArrayLike) -> None:
        """Write an orientation sensor's reading: world_from_sensor, scalar first.

        Raises
        ------
        InvalidInputError
            If it is no unit quaternion, or its time is not after the one before: it is then not in the file.
        """
        where = f"{self.path}: /orientation at {time_s} s"
        rotations_from_quaternions(np.asarray(quaternion_wxyz)[None], where)
        with self._writing():
            self._orientation.append(quaternion_wxyz, time_s)

    def close(self, complete: bool = True) -> None:
        """End the file; closing twice does nothing."""
        file, self._file = self._file, None
        if file is None:
            return
        try:
            with self._writing():
                file[GROWING][...] = not complete
        except FileError:
            if complete:
                raise
        finally:
            file.close()
            trim(self.path)
            if not len(self):  # no sweep is without frames
                self.path.unlink(missing_ok=True)

    def _begin(self, file: h5py.File) -> None:
        file.attrs.update({"format": FORMAT, "version": self._frames.version})
        if self._probe:
            file.attrs["probe"] = self._probe
        self._frames.create(file)
        self._clock = _Stream(file, {"frame_time_s": ()})
        tracker, orientation = (file.create_group(name) for name in ("tracker", "orientation"))
        # Times last: what has a time is whole.
        self._tracker = _Stream(tracker, {"world_from_sensor": (4, 4), "valid": (), "time_s": ()})
        self._orientation = _Stream(orientation, {"quaternion_wxyz": (4,), "time_s": ()})
        for group in (tracker, orientation):
            group.attrs["time_offset_s"] = self._offset_s
        if self._mounting is not None:
            group = tracker if isinstance(self._mounting, RigidTransform) else orientation
            group.attrs.update(mounting_attribute(self._mounting))
        file[GROWING] = np.uint8(1)
        label(file)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except Speckle3DError:
            raise
        except (OSError, RuntimeError) as error:
            failure = error if isinstance(error, OSError) else OSError(str(error))
            raise cannot_write(self.path, failure) from error


class _Stream:
    """Data sets of a group that grow row by row, the last data set last."""

    def __init__(self, group: h5py.Group, shapes: dict[str, tuple[int, ...]]) -> None:
        self._where, self._file = f"{group.file.filename}: {group.name}", group.file.id
        self._nodes = [
            group.create_dataset(
                name, (0, *shape), "?" if name == "valid" else "f8", maxshape=(None, *shape),
                chunks=(_ROWS_PER_CHUNK, *shape), fillvalue=None if name == "valid" else np.nan,
            )
            for name, shape in shapes.items()
        ]  # fmt: skip
        self._time_s = -np.inf

    def require_after(self, time_s: float) -> None:
        """Raise unless a time is after that of the last row."""
        if not (np.isfinite(time_s) and time_s > self._time_s):
            raise InvalidInputError(f"{self._where}: expected a time after {self._time_s} s, got {time_s}")

    def append(self, *values: Any) -> None:
        """Write a row, its time last, and hand it to the operating system."""
        self.require_after(values[-1])
        reserve(self._file)
        for node, value in zip(self._nodes, values, strict=True):
            node.resize(len(node) + 1, axis=0)
            node[-1] = value
            node.id.flush()
        self._time_s = values[-1]
