"""The reconstruction file, version 1: frame pairs are written as they come, and the file is read whole."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.geometry import require_finite, require_increasing, transforms_from_matrices
from speckle3d.core.reconstruction import (
    MODES,
    CalibrationFile,
    FramePairs,
    Provenance,
    Reconstruction,
    Trust,
)
from speckle3d.core.sweep import ImageGrid
from speckle3d.io.hdf5 import (
    PathLike,
    atomic_hdf5,
    find_group,
    locate,
    opened,
    read_attribute,
    read_checked,
    read_text,
    require_dataset,
)

FORMAT = "speckle3d.reconstruction"
VERSION = 1

_PAIR_FIELDS: dict[str, tuple[tuple[int | str, ...], npt.DTypeLike]] = {
    "first": ((), np.int64),
    "second": ((), np.int64),
    "first_from_second": ((4, 4), np.float64),
    "covariance": ((6, 6), np.float64),
    "distance_mm": (("patch",), np.float32),
    "sigma_mm": (("patch",), np.float32),
    "used": (("patch",), np.bool_),
}
"""Shape behind the pair axis, and type, of every data set of /pairs but ``patch_centre_mm``."""

_GRID_FIELDS = (
    "vectors",
    "samples",
    "vector_pitch_mm",
    "sample_spacing_mm",
    "first_sample_depth_mm",
)
_PROVENANCE_FIELDS = ("input_path", "input_sha256", "package_version")
_CHUNK_BYTES = 2**18


class ReconstructionWriter:
    """Write a reconstruction file: open it before the work, append pairs as they come, finish it.

    It appears whole when the block ends, or not at all. Opening it first shows an unwritable place before
    the work instead of after.

    Parameters
    ----------
    path : path
    frame_time_s : ndarray, shape (n,)
    grid : ImageGrid
        Of the sweep's images, so that a volume can be made from the file and the sweep.
    """

    def __init__(self, path: PathLike, frame_time_s: npt.ArrayLike, grid: ImageGrid) -> None:
        self._path, self._grid = path, grid
        self._times = require_increasing(frame_time_s, f"{path}: /frame_time_s")
        self._stack = ExitStack()
        self._finished = False

    def __enter__(self) -> ReconstructionWriter:
        with ExitStack() as stack:
            self._file: h5py.File = stack.enter_context(atomic_hdf5(self._path, FORMAT, VERSION))
            self._file["frame_time_s"] = self._times
            for name in _GRID_FIELDS:
                self._file.attrs[name] = getattr(self._grid, name)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            self._stack.__exit__(kind, error, trace)
            return
        with self._stack:
            if not self._finished:
                raise InvalidInputError(f"{self._path}: expected finish() before the end, got none")

    def append_pairs(self, pairs: FramePairs) -> None:
        """Append frame pairs; their patches must be those of the pairs before.

        Raises
        ------
        InvalidInputError
            If a field has another shape or a frame index is out of range.
        """
        where = f"{self._path}: /pairs"
        _check_pairs(pairs, self._times.size, where)
        group = self._file.require_group("pairs")
        if "first" not in group:
            _create_pairs(group, pairs)
        elif not np.array_equal(group["patch_centre_mm"], pairs.patch_centre_mm):
            raise InvalidInputError(f"{where}/patch_centre_mm: expected the patches of the pairs before")
        for name in _PAIR_FIELDS:
            _extend(group[name], getattr(pairs, name))

    def finish(
        self,
        poses: Mapping[str, RigidTransform],
        provenance: Provenance,
        config_toml: str = "",
        trust: Trust | None = None,
    ) -> None:
        """Write the poses by mode, where they came from, the configuration and how far to trust them."""
        group = self._file.create_group("poses")
        with naming(str(self._path)):
            # Checked by the container before anything is written.
            Reconstruction(self._times, self._grid, dict(poses), provenance, config_toml, None, trust)
        for mode, world_from_image in poses.items():
            group[mode] = world_from_image.as_matrix()
        if trust is not None:
            self._file["pose_covariance/image"] = trust.covariance
            self._file["frame_flags"] = trust.flags
        for name in _PROVENANCE_FIELDS:
            self._file.attrs[name] = getattr(provenance, name)
        for used in provenance.calibrations:
            self._file.require_group(f"calibrations/{used.sensor}").attrs.update(
                path=used.path, sha256=used.sha256
            )
        self._file["config_toml"] = config_toml
        self._finished = True


def read_reconstruction(path: PathLike, with_pairs: bool = True) -> Reconstruction:
    """Read a reconstruction file.

    Parameters
    ----------
    with_pairs : bool
        Whether to read the frame pairs, by far the larger part.

    Raises
    ------
    FileError
        If the file is missing, truncated or not HDF5.
    InvalidInputError
        Naming the file, the data set and the first bad index.
    """
    with opened(path, FORMAT, VERSION) as file:
        times = read_checked(file, "frame_time_s", ("frame",))
        with naming(str(path)):
            return Reconstruction(
                frame_time_s=require_increasing(times, locate(file, "frame_time_s")),
                grid=_read_grid(file),
                poses=_read_poses(file, times.size),
                provenance=_read_provenance(file),
                config_toml=_read_config(file),
                pairs=_read_pairs(file, times.size) if with_pairs else None,
                trust=_read_trust(file, times.size),
            )


def _create_pairs(group: h5py.Group, pairs: FramePairs) -> None:
    group["patch_centre_mm"] = pairs.patch_centre_mm
    for name, (_, dtype) in _PAIR_FIELDS.items():
        values = np.asarray(getattr(pairs, name), dtype=dtype)
        row = values.shape[1:]
        row_bytes = max(int(np.prod(row, dtype=int)) * values.dtype.itemsize, 1)
        chunks = (max(_CHUNK_BYTES // row_bytes, 1), *(max(n, 1) for n in row))
        group.create_dataset(
            name,
            shape=(0, *row),
            maxshape=(None, *row),
            chunks=chunks,
            dtype=dtype,
            compression="lzf",
            shuffle=True,
        )


def _extend(node: h5py.Dataset, rows: npt.NDArray[Any]) -> None:
    start = node.shape[0]
    node.resize(start + len(rows), axis=0)
    node[start:] = rows


def _check_pairs(pairs: FramePairs, frames: int, where: str) -> None:
    lengths: dict[int | str, int | str] = {"patch": int(pairs.patch_centre_mm.shape[0])}
    for name, (row, _) in _PAIR_FIELDS.items():
        expected = (len(pairs), *(lengths.get(n, n) for n in row))
        got = np.shape(getattr(pairs, name))
        if got != expected:
            raise InvalidInputError(f"{where}/{name}: expected shape {expected}, got {got}")
    bad = np.flatnonzero((pairs.first < 0) | (pairs.second <= pairs.first) | (pairs.second >= frames))
    if bad.size:
        i = int(bad[0])
        raise InvalidInputError(
            f"{where}[{i}]: expected frames 0 <= first < second < {frames}, "
            f"got {pairs.first[i]} and {pairs.second[i]}"
        )


def _read_provenance(file: h5py.File) -> Provenance:
    held = find_group(file, "calibrations")
    # Older files have no such group.
    groups = {} if held is None else {sensor: find_group(held, sensor) for sensor in held}
    calibrations = tuple(
        CalibrationFile(sensor, read_text(group, "path"), read_text(group, "sha256"))
        for sensor, group in groups.items()
        if group is not None
    )
    return Provenance(
        **{name: read_text(file, name) for name in _PROVENANCE_FIELDS}, calibrations=calibrations
    )


def _read_grid(file: h5py.File) -> ImageGrid:
    return ImageGrid(
        vectors=int(read_attribute(file, "vectors")),
        samples=int(read_attribute(file, "samples")),
        vector_pitch_mm=read_attribute(file, "vector_pitch_mm"),
        sample_spacing_mm=read_attribute(file, "sample_spacing_mm"),
        first_sample_depth_mm=read_attribute(file, "first_sample_depth_mm"),
    )


def _read_poses(file: h5py.File, frames: int) -> dict[str, RigidTransform]:
    group = find_group(file, "poses")
    if group is None:
        raise InvalidInputError(f"{locate(file, 'poses')}: expected a group, got none")
    held = [mode for mode in MODES if mode in group]
    return {mode: _read_mode(group, mode, frames) for mode in held}


def _read_mode(group: h5py.Group, mode: str, frames: int) -> RigidTransform:
    return transforms_from_matrices(read_checked(group, mode, (frames, 4, 4)), locate(group, mode))


def _read_trust(file: h5py.File, frames: int) -> Trust | None:
    if "pose_covariance" not in file or "frame_flags" not in file:
        return None
    covariance = read_checked(file, "pose_covariance/image", (frames, 6, 6))
    require_finite(covariance, locate(file, "pose_covariance/image"))
    return Trust(covariance, read_checked(file, "frame_flags", (frames,), np.int64))


def _read_config(file: h5py.File) -> str:
    node = require_dataset(file, "config_toml")
    if h5py.check_string_dtype(node.dtype) is None or node.shape != ():
        raise InvalidInputError(f"{locate(file, 'config_toml')}: expected a text, got {node.dtype}")
    return str(node.asstr(errors="replace")[()])


def _read_pairs(file: h5py.File, frames: int) -> FramePairs | None:
    group = find_group(file, "pairs")
    if group is None:
        return None
    first = read_checked(group, "first", ("pair",), np.int64)
    centres: FloatArray = read_checked(group, "patch_centre_mm", ("patch", 2))
    lengths: dict[int | str, int | str] = {"patch": len(centres)}
    values = {
        name: read_checked(group, name, (first.size, *(lengths.get(n, n) for n in row)), dtype)
        for name, (row, dtype) in _PAIR_FIELDS.items()
    }
    pairs = FramePairs(patch_centre_mm=centres, **values)
    _check_pairs(pairs, frames, locate(group))
    transforms_from_matrices(pairs.first_from_second, locate(group, "first_from_second"))
    return pairs
