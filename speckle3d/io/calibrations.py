"""Calibrations on disk (format ``speckle3d.calibration``, version 1).

Attributes of the file: ``method``, ``sensor``, ``rms``, ``rms_unit``, ``condition_number``, ``verdict`` and,
where it is known, ``time_offset_s``. Data sets: ``/sensor_from_image`` (4, 4), or ``/sensor_from_image_wxyz``
(4,) of a sensor that knows its orientation only; ``/pixel_mm`` (2,), where known; ``/covariance`` (6, 6) or
(3, 3), as `speckle3d.core.calibration.Calibration` has it; ``/parameters/name``, ``value``,
``standard_error`` and ``unit`` (p,); ``/frames/used`` (u,), ``dropped`` and ``reason`` (d,), with attribute
``given``; ``/source`` with attributes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import h5py
import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.calibration import Calibration, FramesUsed, Parameter, calibrated
from speckle3d.core.errors import InvalidInputError, MismatchError, naming
from speckle3d.core.geometry import require_finite, rotations_from_quaternions
from speckle3d.core.reconstruction import CalibrationFile
from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.io.hdf5 import (
    PathLike,
    has_member,
    locate,
    opened,
    plain_attribute,
    read_attribute,
    read_checked,
    read_texts,
    read_transforms,
    require_group,
    sha256_of,
)
from speckle3d.io.records import HDF5Writer, read_record

FORMAT = "speckle3d.calibration"


def write_calibration(path: PathLike, calibration: Calibration) -> None:
    """Write a calibration; the file appears whole or not at all.

    Parameters
    ----------
    path : path
        HDF5 file to write.
    calibration : Calibration

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    with HDF5Writer(path, FORMAT) as writer:
        root, apart = writer.file, ("rotation", "translation_mm", "parameters", "frames")
        writer.put_fields(root, calibration, skip=apart)
        is_turn = calibration.translation_mm is None
        writer.put(
            root, "sensor_from_image", calibration.rotation if is_turn else calibration.sensor_from_image
        )
        rows = calibration.parameters
        group = root.create_group("parameters")
        for name in ("name", "unit"):
            writer.put_text(group, name, [getattr(row, name) for row in rows])
        for name in ("value", "standard_error"):
            writer.put(group, name, np.array([getattr(row, name) for row in rows], dtype=float))
        frames = calibration.frames
        group = root.create_group("frames")
        writer.put(group, "given", frames.given)
        writer.put(group, "used", np.array(frames.used, dtype=np.int64))
        writer.put(group, "dropped", np.array(list(frames.dropped), dtype=np.int64))
        writer.put_text(group, "reason", list(frames.dropped.values()))


def read_calibration(path: PathLike) -> Calibration:
    """Read a calibration, and check it.

    Parameters
    ----------
    path : path
        HDF5 file of `speckle3d calibrate`.

    Returns
    -------
    Calibration

    Raises
    ------
    FileError
        If the file is missing, truncated or not HDF5.
    InvalidInputError
        Naming the file and what in it is wrong.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> made = Calibration(
    ...     "orientation", "orientation", Rotation.from_rotvec([0, 0, 0.1]), None, None, 1e-6 * np.eye(3),
    ...     (), 0.01, "rad", 12.0, FramesUsed(2, (0, 1)),
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_calibration(f"{folder}/imu.h5", made)
    ...     read_calibration(f"{folder}/imu.h5").rotation.as_rotvec().round(6).tolist()
    [0.0, 0.0, 0.1]
    """
    with opened(path, FORMAT) as file, naming(str(path)):
        rotation, translation = _read_pose(file)
        condition = np.asarray(plain_attribute(file, "condition_number"))
        # Infinite where the motion leaves something undetermined, unlike all other attributes.
        if condition.dtype.kind not in "fiu" or condition.size != 1 or np.isnan(condition).any():
            raise InvalidInputError("attribute condition_number: expected a number, got another value")
        calibration = read_record(
            file,
            Calibration,
            rotation=rotation,
            translation_mm=translation,
            pixel_mm=read_checked(file, "pixel_mm", (2,)) if has_member(file, "pixel_mm") else None,
            parameters=_read_parameters(require_group(file, "parameters")),
            condition_number=float(condition.ravel()[0]),
            frames=_read_frames(require_group(file, "frames")),
        )
        where = locate(file, "covariance")
        _require_spread(np.diag(calibration.covariance), where)
        if np.isnan(calibration.covariance).any():
            raise InvalidInputError(f"{where}: expected numbers, got NaN")
        return calibration


def apply_calibrations(sweep: Sweep, paths: Sequence[PathLike]) -> tuple[Sweep, tuple[CalibrationFile, ...]]:
    """Put calibration files on a sweep's sensors, one to a sensor, and tell which they were.

    Raises
    ------
    FileError, InvalidInputError
        Naming the file and what in it is wrong.
    MismatchError
        If two are for one sensor, or the sweep has no such sensor.
    """
    held: list[CalibrationFile] = []
    for path in paths:
        calibration = read_calibration(path)
        before = [one.path for one in held if one.sensor == calibration.sensor]
        if before:
            raise MismatchError(f"{path}: expected one calibration for a sensor, got {before[0]} for it too")
        with naming(str(path)):
            sweep = calibrated(sweep, calibration)
        held.append(CalibrationFile(calibration.sensor, str(path), sha256_of(path)))
    return sweep, tuple(held)


def fitted_pixels(paths: Sequence[PathLike]) -> dict[str, float]:
    """Return the pixel size of the first calibration that has one, as import settings of B-mode images."""
    for path in paths:
        pixel_mm = read_calibration(path).pixel_mm
        if pixel_mm is not None:
            return {"column_pitch_mm": float(pixel_mm[0]), "row_spacing_mm": float(pixel_mm[1])}
    return {}


def resized(sweep: Sweep, sizes: dict[str, float]) -> Sweep:
    """Replace the pixel size of a sweep of B-mode images; names are those of the import settings."""
    if not isinstance(sweep.signal, BModeSettings):
        return sweep
    grid = sweep.grid
    column_mm = sizes.get("column_pitch_mm", grid.vector_pitch_mm)
    row_mm = sizes.get("row_spacing_mm", grid.sample_spacing_mm)
    # Rows count from the probe's face, including those above the first stored row.
    first_mm = grid.first_sample_depth_mm * row_mm / grid.sample_spacing_mm
    fitted = replace(
        grid, vector_pitch_mm=column_mm, sample_spacing_mm=row_mm, first_sample_depth_mm=first_mm
    )
    return replace(sweep, grid=fitted)


def _read_parameters(group: h5py.Group) -> tuple[Parameter, ...]:
    values = read_checked(group, "value", ("p",))
    require_finite(values, locate(group, "value"))
    errors = read_checked(group, "standard_error", (values.size,))
    _require_spread(errors, locate(group, "standard_error"))
    names, units = (read_texts(group, name, values.shape) for name in ("name", "unit"))
    rows = zip(names, values.tolist(), errors.tolist(), units, strict=True)
    return tuple(Parameter(*row) for row in rows)


def _read_frames(group: h5py.Group) -> FramesUsed:
    used = read_checked(group, "used", ("u",), np.int64)
    dropped = read_checked(group, "dropped", ("d",), np.int64)
    reasons = read_texts(group, "reason", dropped.shape)
    given = int(read_attribute(group, "given"))
    for name, numbers in (("used", used), ("dropped", dropped)):
        bad = np.flatnonzero((numbers < 0) | (numbers >= given))
        if bad.size:
            where = f"{locate(group, name)}[{bad[0]}]"
            raise InvalidInputError(f"{where}: expected a frame among {given}, got {numbers[bad[0]]}")
    return FramesUsed(given, tuple(used.tolist()), dict(zip(dropped.tolist(), reasons, strict=True)))


def _read_pose(file: h5py.File) -> tuple[Rotation, FloatArray | None]:
    if has_member(file, "sensor_from_image"):
        pose = read_transforms(file, "sensor_from_image")
        return pose.rotation, np.asarray(pose.translation)
    quaternion = read_checked(file, "sensor_from_image_wxyz", (4,))
    return rotations_from_quaternions(quaternion[None], locate(file, "sensor_from_image_wxyz"))[0], None


def _require_spread(values: FloatArray, where: str) -> None:
    """Refuse negative or NaN standard errors; an infinite one marks what the motion did not determine."""
    bad = np.flatnonzero(~(values >= 0))
    if bad.size:
        raise InvalidInputError(f"{where}[{bad[0]}]: expected zero or a value above it, got {values[bad[0]]}")


load_calibration = read_calibration
"""Its public name, `speckle3d.load_calibration`."""
