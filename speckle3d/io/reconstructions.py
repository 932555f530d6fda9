"""The reconstruction file, version 1: frame pairs are written as they come, and the file is read whole."""

from __future__ import annotations

from collections.abc import Mapping

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
    ImportRecord,
    ModeErrors,
    Provenance,
    Reconstruction,
    SharedErrors,
    SourceFile,
    Trust,
)
from speckle3d.core.sweep import ImageGrid
from speckle3d.io.hdf5 import (
    HDF5Writer,
    PathLike,
    find_group,
    has_member,
    locate,
    opened,
    read_attributes,
    read_checked,
    read_text,
    read_texts,
    read_transforms,
    read_vector_attribute,
    require_group,
    write_attributes,
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

_GRID = dict.fromkeys(("vectors", "samples"), int) | dict.fromkeys(
    ("vector_pitch_mm", "sample_spacing_mm", "first_sample_depth_mm"), float
)
_PROVENANCE = dict.fromkeys(("input_path", "input_sha256", "package_version"), str)
_SOURCE = dict.fromkeys(("path", "sha256"), str)
_SHARED = dict.fromkeys(("scale_sigma", "curves_sigma"), float)
_TURN = "turn_sigma_per_mm"
_CHUNK_BYTES = 2**18


class ReconstructionWriter(HDF5Writer):
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
        super().__init__(path, FORMAT, VERSION)
        self._grid = grid
        self._times = require_increasing(frame_time_s, f"{path}: /frame_time_s")
        self._finished = False

    def _begin(self) -> None:
        self._file["frame_time_s"] = self._times
        write_attributes(self._file, self._grid, _GRID)

    def _finish(self) -> None:
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
        start = len(group["first"])
        for name in _PAIR_FIELDS:
            group[name].resize(start + len(pairs), axis=0)
            group[name][start:] = getattr(pairs, name)
        self._require_room()

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
            self._write_trust(trust)
        write_attributes(self._file, provenance, _PROVENANCE)
        for used in provenance.calibrations:
            write_attributes(self._file.require_group(f"calibrations/{used.sensor}"), used, _SOURCE)
        if provenance.crossing is not None:
            write_attributes(self._file.require_group("crossing"), provenance.crossing, _SOURCE)
        if provenance.imported is not None:
            group = self._file.create_group("import")
            write_attributes(group, provenance.imported, ("name",))
            # A mapping of arrays may be more than an attribute holds.
            group["settings_json"] = provenance.imported.settings_json
        self._file["config_toml"] = config_toml
        self._finished = True

    def _write_trust(self, trust: Trust) -> None:
        group = self._file.create_group("pose_covariance")
        group["image"] = trust.covariance
        if trust.shared is not None:
            write_attributes(group["image"], trust.shared, (*_SHARED, _TURN))
        for mode, claimed in trust.modes.items():
            group[mode] = claimed.covariance
            write_attributes(group[mode], claimed, ("length_sigma",))
        self._file["frame_flags"] = trust.flags


def read_reconstruction(path: PathLike, with_pairs: bool = True) -> Reconstruction:
    """Read a reconstruction file.

    Parameters
    ----------
    with_pairs : bool
        Whether to read the frame pairs, by far the larger part.
    path : path
        ``reconstruction.h5`` of a results folder.

    Returns
    -------
    Reconstruction

    Raises
    ------
    FileError
        If the file is missing, truncated or not HDF5.
    InvalidInputError
        Naming the file, the data set and the first bad index.
    """
    with opened(path, FORMAT, (VERSION,)) as file:
        times = read_checked(file, "frame_time_s", ("frame",))
        with naming(str(path)):
            return Reconstruction(
                frame_time_s=require_increasing(times, locate(file, "frame_time_s")),
                grid=ImageGrid(**read_attributes(file, _GRID)),
                poses=_read_poses(file, times.size),
                provenance=_read_provenance(file),
                config_toml=read_texts(file, "config_toml", ()),
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


def _check_pairs(pairs: FramePairs, frames: int, where: str) -> None:
    patches = len(pairs.patch_centre_mm)
    for name, (row, _) in _PAIR_FIELDS.items():
        expected = (len(pairs), *(patches if n == "patch" else n for n in row))
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
    # Older files have no such group.
    held = find_group(file, "calibrations") or {}
    calibrations = [
        CalibrationFile(sensor, **read_attributes(require_group(held, sensor), _SOURCE)) for sensor in held
    ]
    crossed = find_group(file, "crossing")
    crossing = None if crossed is None else SourceFile(**read_attributes(crossed, _SOURCE))
    held = find_group(file, "import")
    imported = None
    if held is not None:
        imported = ImportRecord(read_text(held, "name"), read_texts(held, "settings_json", ()))
    return Provenance(
        **read_attributes(file, _PROVENANCE),
        calibrations=tuple(calibrations),
        crossing=crossing,
        imported=imported,
    )


_EARLIER = {"consistent-subset": "image+subset"}
"""Names of modes in older files."""


def _read_poses(file: h5py.File, frames: int) -> dict[str, RigidTransform]:
    group = require_group(file, "poses")
    names = {mode: mode if has_member(group, mode) else _EARLIER.get(mode, mode) for mode in MODES}
    return {
        mode: read_transforms(group, name, frames) for mode, name in names.items() if has_member(group, name)
    }


def _read_trust(file: h5py.File, frames: int) -> Trust | None:
    if not (has_member(file, "pose_covariance") and has_member(file, "frame_flags")):
        return None
    group = require_group(file, "pose_covariance")
    modes = {}
    for mode in MODES[1:]:
        if has_member(group, mode):
            modes[mode] = ModeErrors(
                _read_covariance(group, mode, frames), **read_attributes(group[mode], {"length_sigma": float})
            )
    flags = read_checked(file, "frame_flags", (frames,), np.int64)
    return Trust(_read_covariance(group, "image", frames), flags, _read_shared(group["image"]), modes)


def _read_covariance(group: h5py.Group, mode: str, frames: int) -> FloatArray:
    covariance = read_checked(group, mode, (frames, 6, 6))
    require_finite(covariance, locate(group, mode))
    return covariance


def _read_shared(covariance: h5py.Dataset) -> SharedErrors | None:
    """What the image's poses have wrong together; older files do not say."""
    if _TURN not in covariance.attrs:
        return None
    turn = read_vector_attribute(covariance, _TURN, 2)
    return SharedErrors(**read_attributes(covariance, _SHARED), turn_sigma_per_mm=turn)


def _read_pairs(file: h5py.File, frames: int) -> FramePairs | None:
    group = find_group(file, "pairs")
    if group is None:
        return None
    values = {
        name: read_checked(group, name, ("pair", *row), dtype) for name, (row, dtype) in _PAIR_FIELDS.items()
    }
    pairs = FramePairs(patch_centre_mm=read_checked(group, "patch_centre_mm", ("patch", 2)), **values)
    _check_pairs(pairs, frames, locate(group))
    transforms_from_matrices(pairs.first_from_second, locate(group, "first_from_second"))
    return pairs
