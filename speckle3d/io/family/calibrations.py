"""Calibrations on disk (format ``speckle3d.calibration``, version 1).

Attributes of the file: ``method``, ``sensor``, ``rms``, ``rms_unit``, ``condition_number``, ``verdict`` and,
where it is known, ``time_offset_s``. Data sets: ``/sensor_from_image`` (4, 4), or ``/sensor_from_image_wxyz``
(4,) of a sensor that knows its orientation only; ``/pixel_mm`` (2,), where known; ``/covariance`` (6, 6) or
(3, 3), as `speckle3d.core.calibration.Calibration` has it; ``/parameters/name``, ``value``,
``standard_error`` and ``unit`` (p,); ``/frames/used`` (u,), ``dropped`` and ``reason`` (d,), with attribute
``given``; ``/source`` with attributes.
"""

import h5py
import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.calibration import Calibration, FramesUsed, Parameter
from speckle3d.core.errors import InvalidInputError
from speckle3d.io.family.records import put, put_fields, read_record, written
from speckle3d.io.family.sweeps import SENSORS
from speckle3d.io.hdf5 import (
    PathLike,
    locate,
    open_family,
    read_array,
    read_attribute,
    read_texts,
    require_group,
)

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
    frames, rows = calibration.frames, calibration.parameters
    with written(path, FORMAT) as file:
        put_fields(file, calibration, skip=("rotation", "translation_mm", "parameters", "frames"))
        is_rotation = calibration.translation_mm is None
        put(file, "sensor_from_image", calibration.rotation if is_rotation else calibration.sensor_from_image)
        for name, make in (("name", list), ("unit", list), ("value", np.array), ("standard_error", np.array)):
            put(file, f"parameters/{name}", make([getattr(row, name) for row in rows]))
        members = {"given": frames.given, "used": np.array(frames.used, int)}
        dropped = {"dropped": np.array([*frames.dropped], int), "reason": [*frames.dropped.values()]}
        put(file, "frames", members | dropped)


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
    >>> calibration = Calibration(
    ...     "orientation", "orientation", Rotation.from_rotvec([0, 0, 0.1]), None, None, 1e-6 * np.eye(3),
    ...     (), 0.01, "rad", 12.0, FramesUsed(2, (0, 1)),
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_calibration(f"{folder}/imu.h5", calibration)
    ...     read_calibration(f"{folder}/imu.h5").rotation.as_rotvec().round(6).tolist()
    [0.0, 0.0, 0.1]
    """
    with open_family(path, FORMAT) as file:
        _, name, shape, check = SENSORS["tracker" if "sensor_from_image" in file else "orientation"]
        pose = check(read_array(file, name, shape)[None], locate(file, name))[0]
        is_rotation = isinstance(pose, Rotation)
        calibration = read_record(
            file,
            Calibration,
            rotation=pose if is_rotation else pose.rotation,
            translation_mm=None if is_rotation else np.asarray(pose.translation),
            parameters=_read_parameters(require_group(file, "parameters")),
            frames=_read_frames(require_group(file, "frames")),
        )
        if not (np.diag(calibration.covariance) >= 0).all():
            raise InvalidInputError(f"{locate(file, 'covariance')}: expected variances of zero or more")
        return calibration


def _read_parameters(group: h5py.Group) -> tuple[Parameter, ...]:
    value, error = (read_array(group, name, ("p",)) for name in ("value", "standard_error"))
    names, units = (read_texts(group, name, value.shape) for name in ("name", "unit"))
    return tuple(map(Parameter, names, value.tolist(), error.tolist(), units))


def _read_frames(group: h5py.Group) -> FramesUsed:
    in_use, left_out = (read_array(group, name, ("n",), np.int64) for name in ("used", "dropped"))
    reasons = read_texts(group, "reason", left_out.shape)
    count = int(read_attribute(group, "given"))
    return FramesUsed(count, tuple(in_use.tolist()), dict(zip(left_out.tolist(), reasons, strict=True)))


load_calibration = read_calibration
"""Its public name, `speckle3d.load_calibration`."""
