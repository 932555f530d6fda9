"""The reconstruction file, version 1."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Self

import h5py
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.geometry import require_finite, require_increasing, transforms_from_matrices
from speckle3d.core.grid import ImageGrid
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
from speckle3d.io.hdf5 import (
    PathLike,
    has_member,
    locate,
    opened,
    read_attribute,
    read_checked,
    read_text,
    read_texts,
    read_transforms,
    read_vector_attribute,
    require_dataset,
    require_group,
)
from speckle3d.io.records import put, put_fields, put_text, read_record, written

FORMAT = "speckle3d.reconstruction"

_PAIR_ROWS = ("first", "second", "first_from_second", "covariance", "distance_mm", "sigma_mm", "used")
"""Data sets of /pairs with a row for each pair."""


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
        self._path, self._grid, self._whole = path, grid, written(path, FORMAT)
        self._times = require_increasing(frame_time_s, f"{path}: /frame_time_s")
        self._pairs: list[FramePairs] = []

    def __enter__(self) -> Self:
        self._file = self._whole.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._whole.__exit__(kind, error, trace)

    def append_pairs(self, pairs: FramePairs) -> None:
        """Append frame pairs; their patches must be those of the pairs before.

        Raises
        ------
        InvalidInputError
            If a frame index is out of range.
        """
        _check_pairs(pairs, self._times.size, f"{self._path}: /pairs")
        self._pairs.append(pairs)

    def finish(
        self,
        poses: Mapping[str, RigidTransform],
        provenance: Provenance,
        config_toml: str = "",
        trust: Trust | None = None,
    ) -> None:
        """Write the poses by mode, where they came from, the configuration and how far to trust them."""
        file = self._file
        with naming(str(self._path)):
            # Checked by the container before anything is written.
            Reconstruction(self._times, self._grid, dict(poses), provenance, config_toml, None, trust)
        put(file, "frame_time_s", self._times)
        put_fields(file, self._grid)
        put(file, "poses", poses)
        if trust is not None:
            modes = {"image": trust.covariance} | {mode: of.covariance for mode, of in trust.modes.items()}
            put(file, "pose_covariance", modes)
            put(file, "frame_flags", trust.flags)
            if trust.shared is not None:
                file["pose_covariance/image"].attrs.update(vars(trust.shared))
            for mode, errors in trust.modes.items():
                file[f"pose_covariance/{mode}"].attrs["length_sigma"] = errors.length_sigma
        put_fields(file, provenance, skip=["calibrations", "imported"])
        for used in provenance.calibrations:
            put(file, f"calibrations/{used.sensor}", SourceFile(used.path, used.sha256))
        if provenance.imported is not None:
            put(file, "import", {"name": provenance.imported.name})
            put_text(file["import"], "settings_json", provenance.imported.settings_json)
        put_text(file, "config_toml", config_toml)
        if self._pairs:
            put(file, "pairs", {"patch_centre_mm": self._pairs[0].patch_centre_mm})
            for name in _PAIR_ROWS:
                rows = np.concatenate([getattr(pairs, name) for pairs in self._pairs])
                put(file["pairs"], name, rows, compression="lzf", shuffle=True)


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
    with opened(path, FORMAT) as file:
        times = read_checked(file, "frame_time_s", ("frame",))
        with naming(str(path)):
            return Reconstruction(
                frame_time_s=require_increasing(times, locate(file, "frame_time_s")),
                grid=read_record(file, ImageGrid),
                poses=_read_poses(file, times.size),
                provenance=_read_provenance(file),
                config_toml=read_texts(file, "config_toml", ()),
                pairs=_read_pairs(file, times.size) if with_pairs else None,
                trust=_read_trust(file, times.size),
            )


load_reconstruction = read_reconstruction
"""Its public name, `speckle3d.load_reconstruction`."""


def _check_pairs(pairs: FramePairs, frames: int, where: str) -> None:
    lengths = {name: len(getattr(pairs, name)) for name in _PAIR_ROWS}
    if len({*lengths.values()}) > 1:
        raise InvalidInputError(f"{where}: expected equally many rows, got {lengths}")
    bad = np.flatnonzero((pairs.first < 0) | (pairs.second <= pairs.first) | (pairs.second >= frames))
    if bad.size:
        i = int(bad[0])
        raise InvalidInputError(
            f"{where}[{i}]: expected frames 0 <= first < second < {frames}, "
            f"got {pairs.first[i]} and {pairs.second[i]}"
        )


def _read_provenance(file: h5py.File) -> Provenance:
    """Where a reconstruction came from; files of versions before 0.1 lack some groups."""
    files = require_group(file, "calibrations") if has_member(file, "calibrations") else {}
    used = [read_record(require_group(files, sensor), CalibrationFile, sensor=sensor) for sensor in files]
    imported = None
    if has_member(file, "import"):
        group = require_group(file, "import")
        imported = ImportRecord(read_text(group, "name"), read_texts(group, "settings_json", ()))
    return read_record(file, Provenance, calibrations=tuple(used), imported=imported)


def _read_poses(file: h5py.File, frames: int) -> dict[str, RigidTransform]:
    group = require_group(file, "poses")
    return {mode: read_transforms(group, mode, frames) for mode in MODES if has_member(group, mode)}


def _read_trust(file: h5py.File, frames: int) -> Trust | None:
    if not (has_member(file, "pose_covariance") and has_member(file, "frame_flags")):
        return None
    group = require_group(file, "pose_covariance")
    covariances = {
        mode: read_checked(group, mode, (frames, 6, 6)) for mode in MODES if has_member(group, mode)
    }
    for mode, values in covariances.items():
        require_finite(values, locate(group, mode))
    image, shared = require_dataset(group, "image"), None
    if "turn_sigma_per_mm" in image.attrs:
        turn = read_vector_attribute(image, "turn_sigma_per_mm", 2)
        shared = read_record(image, SharedErrors, turn_sigma_per_mm=turn)
    covariance = covariances.pop("image")
    modes = {
        mode: ModeErrors(values, read_attribute(group[mode], "length_sigma"))
        for mode, values in covariances.items()
    }
    return Trust(covariance, read_checked(file, "frame_flags", (frames,), np.int64), shared, modes)


def _read_pairs(file: h5py.File, frames: int) -> FramePairs | None:
    if not has_member(file, "pairs"):
        return None
    group = require_group(file, "pairs")
    pairs = read_record(group, FramePairs)
    _check_pairs(pairs, frames, locate(group))
    transforms_from_matrices(pairs.first_from_second, locate(group, "first_from_second"))
    return pairs
