"""Frozen dataclasses as groups of an HDF5 file, and files of them that appear whole or not at all."""

import fnmatch
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import h5py
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import naming
from speckle3d.core.files import PathLike
from speckle3d.io.hdf5 import (
    atomic_path,
    has_member,
    locate,
    read_array,
    read_attribute,
    read_text,
    read_vector_attribute,
    require_group,
)

_AHEAD_BYTES, _SPARE_BYTES = 16 * 2**20, 2**18
"""Room on the disk that is taken before it is needed, and what HDF5 may need for its own after a write."""

Record = TypeVar("Record")

MEANINGS = """\
rf                             1: echoes before demodulation, (frame, vector, sample)
iq                             1: echoes after demodulation, I + iQ, (frame, vector, sample)
bmode                          1: grey levels, (frame, column, row)
frame_time_s                   s: time of each frame, strictly increasing
*/time_s                       s: time of each reading on the sensor's clock; add time_offset_s for image time
orientation/quaternion_wxyz    1: world_from_sensor, unit quaternions, scalar first
orientation/accelerometer_m_s2 m/s^2: specific force along the sensor's axes
orientation/gyroscope_rad_s    rad/s: turn rate about the sensor's axes
orientation/magnetometer_au    arbitrary: magnetic field along the sensor's axes
tracker/world_from_sensor      mm: rigid matrices, sensor coordinates to the tracker's world
tracker/valid                  1: whether a reading may be used
truth/world_from_image         mm: true rigid matrices, image coordinates (x lateral, y axial) to the world
depth_mm                       mm: depth of each curve below the probe's face
distance_mm                    mm: elevational distance of two frames
correlation                    1: correlation of fully developed speckle, (depth, distance)
cells                          1: independent speckle cells in a patch, per depth
speckle/axial_mm               mm: size of the phantom's speckle along the beam, per depth
speckle/lateral_mm             mm: size of the phantom's speckle across the beam, per depth
tilt/pivot_mm                  mm: depth that tilted frames seem to turn about, per depth
tilt/spread_mm                 mm: distance that tilt adds, per depth
sensor_from_image              mm: rigid matrix, image coordinates (x lateral, y axial) to the sensor's
sensor_from_image_wxyz         1: image axes to sensor axes, unit quaternion, scalar first
pixel_mm                       mm: distance between columns and between rows
covariance                     rad and mm: of tilt, yaw, roll, then x, y, z of the image in its own frame
parameters/name                : name of each parameter, as in its report
parameters/value               as in parameters/unit: estimate of each parameter
parameters/standard_error      as in parameters/unit: standard error of each parameter
parameters/unit                : unit of each parameter
frames/used                    1: indices of the frames that were used, from 0
frames/dropped                 1: indices of the frames that were left out, from 0
frames/reason                  : why each of these was left out
config_toml                    : every setting of the run, as TOML
frame_flags                    1: bits of what was found wrong with each frame; 0: nothing
poses/*                        mm: rigid matrices, image coordinates (x lateral, y axial) to the mode's world
pose_covariance/*              mm and rad: of each frame's x, y, z, tilt, yaw, roll about the image's centre
pairs/first                    1: index of the earlier frame of each pair, from 0
pairs/second                   1: index of the later frame of each pair, from 0
pairs/first_from_second        mm: rigid matrices, the later image's coordinates to the earlier's
pairs/covariance               mm and rad: of x, y, z, tilt, yaw, roll of each pair, at the image's centre
pairs/patch_centre_mm          mm: lateral and axial place of each patch in the image
pairs/distance_mm              mm: unsigned elevational distance of each patch of each pair
pairs/sigma_mm                 mm: standard deviation of these distances
pairs/used                     1: whether a patch took part in its pair's pose
*settings_json                 : settings that the recording was read with, as JSON
"""
"""Patterns of data sets' names, their unit and, behind a colon, what they hold."""


def reserve(file: h5py.h5f.FileID, more_bytes: int = 0) -> None:
    """Take room on the disk before HDF5 needs it, so that a full disk is an error before HDF5 meets it.

    HDF5 cannot close a file whose last bytes it cannot write, and takes the interpreter down with it. Without
    ``posix_fallocate``, as on Windows and macOS, nothing is taken.

    Raises
    ------
    OSError
        If there is none.
    """
    handle, stop = file.get_vfd_handle(), file.get_filesize() + more_bytes + _SPARE_BYTES
    if hasattr(os, "posix_fallocate") and os.fstat(handle).st_size < stop:
        os.posix_fallocate(handle, 0, stop + min(stop, _AHEAD_BYTES))


def trim(path: Path) -> None:
    """Free reserved disk space of a closed file: HDF5 cuts off what lies behind its end."""
    with h5py.File(path, "r+", locking=False):  # somebody may be reading it
        pass


@contextmanager
def written(path: PathLike, format_name: str, version: int = 1) -> Iterator[h5py.File]:
    """Yield a new file of the family; it appears whole when the block ends, or not at all."""
    with atomic_path(path) as part:
        with h5py.File(part, "w", locking=False) as file:
            reserve(file.id)
            put(file, "format", format_name)
            put(file, "version", version)
            yield file
            label(file)
        trim(part)


def label(file: h5py.File) -> None:
    """Give every data set of a file of the family its attributes `units` and `meaning`."""
    names = list[str]()
    file.visit(names.append)
    for row in MEANINGS.splitlines():
        pattern, words = row.split(maxsplit=1)
        for name in fnmatch.filter(names, pattern):
            attributes = file[name].attrs
            # Of fixed length: HDF5 never returns from zeros among texts of variable length.
            attributes["units"], _, attributes["meaning"] = map(np.bytes_, words.encode().partition(b": "))


def put_fields(group: h5py.Group, record: object, skip: Sequence[str] = ()) -> None:
    """Write each field of a dataclass by its name, but those to skip."""
    for name, value in vars(record).items():
        if name not in skip:
            put(group, name, value)


def put(group: h5py.Group, name: str, value: Any) -> None:
    """Write a value under a name by its type.

    Numbers, texts and tuples of numbers become attributes, arrays, lists of texts and rigid transforms data
    sets, rotations a data set of quaternions with ``_wxyz`` behind its name, dataclasses and mappings
    groups. None is not written.
    """
    if value is None:
        return
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, Mapping):
        inner = group.require_group(name)
        for key, item in value.items():
            put(inner, key, item)
    elif isinstance(value, str | int | float | tuple):
        group.attrs[name] = value
    elif isinstance(value, list):
        group.create_dataset(name, data=value, dtype=h5py.string_dtype())
    elif isinstance(value, Rotation):
        put(group, f"{name}_wxyz", value.as_quat(scalar_first=True))
    else:
        values = np.asarray(value.as_matrix() if isinstance(value, RigidTransform) else value)
        reserve(group.file.id, values.nbytes)
        group.create_dataset(name, data=values)


def read_record(group: h5py.Group, kind: type[Record], **values: Any) -> Record:
    """Read a dataclass that `put_fields` wrote; older files may lack fields with a default.

    Parameters
    ----------
    values : any
        Fields that are not read, by name.

    Raises
    ------
    InvalidInputError
        Naming the field that is missing, or of another kind.
    """
    hints = get_type_hints(kind)
    for field in fields(kind):  # type: ignore[arg-type]
        name, hint = field.name, hints[field.name]
        is_there, is_optional = has_member(group, name) or name in group.attrs, NoneType in get_args(hint)
        has_default = field.default is not MISSING or field.default_factory is not MISSING
        if name in values:
            continue
        if is_there or not (has_default or is_optional):
            values[name] = _read_value(group, name, get_args(hint)[0] if is_optional else hint)
        elif not has_default:
            values[name] = None
    with naming(locate(group)):
        return kind(**values)


def _read_value(group: h5py.Group, name: str, hint: Any) -> Any:
    """Read an attribute, an array or a group by the type of the field that it is for."""
    if is_dataclass(hint):
        return read_record(require_group(group, name), hint)  # type: ignore[arg-type]
    if hint is bool:
        return bool(group.attrs[name])
    if hint in (int, float):
        return hint(read_attribute(group, name))
    origin, parts = get_origin(hint), get_args(hint)
    if hint is str or origin is Literal:
        return read_text(group, name)
    if origin is tuple:
        return tuple(read_vector_attribute(group, name, len(parts)).tolist())
    return read_array(group, name, None, get_args(parts[1])[0])
