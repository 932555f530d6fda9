"""The reconstruction file, version 1."""

from collections.abc import Sequence

import h5py
import numpy as np

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.geometry import require_increasing
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
    Trust,
)
from speckle3d.io.family.records import put, put_fields, read_record, written
from speckle3d.io.hdf5 import (
    PathLike,
    locate,
    open_family,
    read_array,
    read_attribute,
    read_text,
    read_texts,
    read_transforms,
    read_vector_attribute,
    require_group,
)

FORMAT = "speckle3d.reconstruction"


def write_reconstruction(path: PathLike, result: Reconstruction, pairs: Sequence[FramePairs] = ()) -> None:
    """Write a reconstruction; the file appears whole or not at all.

    Parameters
    ----------
    path : path
    result : Reconstruction
    pairs : sequence of FramePairs
        The frame pairs in parts, in place of those of `result`.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    origin, trust = result.provenance, result.trust
    parts = pairs or ([] if result.pairs is None else [result.pairs])
    with written(path, FORMAT) as file:
        put(file, "frame_time_s", result.frame_time_s)
        put_fields(file, result.grid)
        put(file, "poses", result.poses)
        if trust is not None:
            put(file, "pose_covariance/image", trust.covariance)
            file["pose_covariance/image"].attrs.update({} if trust.shared is None else vars(trust.shared))
            for mode, errors in trust.modes.items():
                put(file, f"pose_covariance/{mode}", errors.covariance)
                file[f"pose_covariance/{mode}"].attrs["length_sigma"] = errors.length_sigma
            put(file, "frame_flags", trust.flags)
        put_fields(file, origin, skip=["calibrations", "imported"])
        for calibration in origin.calibrations:
            put(file, f"calibrations/{calibration.sensor}", calibration)
        if origin.imported is not None:
            put(file, "import", {"name": origin.imported.name})
            file["import/settings_json"] = origin.imported.settings_json
        file["config_toml"] = result.config_toml
        if parts:
            rows = {name: np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])}
            put(file, "pairs", rows | {"patch_centre_mm": parts[0].patch_centre_mm})


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
    with open_family(path, FORMAT) as file:
        times, group = read_array(file, "frame_time_s", ("frame",)), require_group(file, "poses")
        modes = [mode for mode in MODES if mode in group]
        return Reconstruction(
            frame_time_s=require_increasing(times, locate(file, "frame_time_s")),
            grid=read_record(file, ImageGrid),
            poses={mode: read_transforms(group, mode, times.size) for mode in modes},
            provenance=_read_provenance(file),
            config_toml=read_texts(file, "config_toml", ()),
            pairs=_read_pairs(file, times.size) if with_pairs else None,
            trust=_read_trust(file, times.size),
        )


load_reconstruction = read_reconstruction
"""Its public name, `speckle3d.load_reconstruction`."""


def _read_provenance(file: h5py.File) -> Provenance:
    """Where a reconstruction came from; files of versions before 0.1 lack some groups."""
    files = require_group(file, "calibrations") if "calibrations" in file else {}
    calibrations = (read_record(files[sensor], CalibrationFile, sensor=sensor) for sensor in files)
    settings = None
    if "import" in file:
        group = require_group(file, "import")
        settings = ImportRecord(read_text(group, "name"), read_texts(group, "settings_json", ()))
    return read_record(file, Provenance, calibrations=tuple(calibrations), imported=settings)


def _read_trust(file: h5py.File, frames: int) -> Trust | None:
    if "pose_covariance" not in file or "frame_flags" not in file:
        return None
    group = require_group(file, "pose_covariance")
    covariances = {mode: read_array(group, mode, (frames, 6, 6)) for mode in MODES if mode in group}
    covariance, flags = covariances.pop("image"), read_array(file, "frame_flags", (frames,), np.int64)
    modes = {
        mode: ModeErrors(values, read_attribute(group[mode], "length_sigma"))
        for mode, values in covariances.items()
    }
    if "turn_sigma_per_mm" not in (image := group["image"]).attrs:
        return Trust(covariance, flags, None, modes)
    turn = read_vector_attribute(image, "turn_sigma_per_mm", 2)
    return Trust(covariance, flags, read_record(image, SharedErrors, turn_sigma_per_mm=turn), modes)


def _read_pairs(file: h5py.File, frames: int) -> FramePairs | None:
    if "pairs" not in file:
        return None
    pairs = read_record(require_group(file, "pairs"), FramePairs)
    is_within = (pairs.first >= 0) & (pairs.first < pairs.second) & (pairs.second < frames)
    if not is_within.all():
        raise InvalidInputError(
            f"{locate(file, 'pairs')}: expected 0 <= first < second < {frames}, got others"
        )
    return pairs
