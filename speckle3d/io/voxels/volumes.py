"""Volumes and label maps as NRRD, MetaImage or NIfTI files, read here so that damage is told in one line."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import ByteArray, FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.files import PathLike, open_regular
from speckle3d.core.geometry import transforms_from_matrices
from speckle3d.core.labels import LABEL_TYPES, LabelMap
from speckle3d.core.volume import VOXEL_TYPES, Volume
from speckle3d.io.hdf5 import reading
from speckle3d.io.headers import SequenceHeader, is_metaimage, is_nrrd, read_header
from speckle3d.io.pixels import read_pixels
from speckle3d.io.text import numbers
from speckle3d.io.voxels.nifti import is_nifti, read_nifti
from speckle3d.io.voxels.segments import is_segmentation, read_segments
from speckle3d.io.voxels.volume_writer import VolumeWriter, own_fields

_SNIFFED_BYTES = 4096

_SAME_PLACE_MM = 1e-3
"""Two grids are one if they differ by less: NIfTI keeps places to single precision."""

_TO_LPS = {
    "left-anterior-superior": (1, -1, 1), "las": (1, -1, 1),
    "right-anterior-superior": (-1, -1, 1), "ras": (-1, -1, 1),
}  # fmt: skip
"""Signs that turn a space of NRRD into the one of MetaImage and this package; others stay as they are."""

_MM = {"": 1.0, "mm": 1.0, "millimeter": 1.0, "cm": 10.0, "m": 1e3, "meter": 1e3, "um": 1e-3, "\u00b5m": 1e-3,
       "micron": 1e-3}  # fmt: skip
"""Millimetres of the units of NRRD and MetaImage."""


def write_volume(path: PathLike, volume: Volume, compress: bool = True) -> None:
    """Write a volume whole or not at all; the suffix chooses the format.

    As `VolumeWriter` does it, with what the labels of a `LabelMap` mean.

    Parameters
    ----------
    path : path
        Ends in .nrrd, .mha, .nii.gz or .nii.
    volume : Volume
    compress : bool
        Whether voxels are packed, where the format can.

    Raises
    ------
    InvalidInputError
        If the suffix is none of `volume_writer.SUFFIXES`.
    FileError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> volume = Volume(np.zeros((4, 3, 2), np.uint8), (0.5, 0.5, 1.0), RigidTransform.identity())
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_volume(f"{folder}/v.nrrd", volume)
    ...     read_volume(f"{folder}/v.nrrd").shape
    (4, 3, 2)
    """
    segments = volume.segments if isinstance(volume, LabelMap) else None
    place = volume.shape, volume.spacing_mm, volume.world_from_grid
    with VolumeWriter(path, *place, volume.voxels.dtype, volume.fields, compress, segments) as writer:
        writer.append(volume.voxels.T)


def is_volume(path: PathLike) -> bool:
    """Whether a file says that it is a volume: NIfTI, or an image whose axes are all of space.

    Raises
    ------
    FileError, InvalidInputError
        If it cannot be read, or its header does not make sense.
    """
    start = _start(path)
    if is_metaimage(start) or is_nrrd(start):
        header = read_header(path)
        return header.is_volume or (header.kinds == 3 * ["domain"] and not header.frames)
    return is_nifti(Path(path), start)


def may_be_volume(path: PathLike) -> bool:
    """Whether a file is a NIfTI image, or a MetaImage or NRRD one without fields of frames near its start.

    Unlike `is_volume` it takes files of programs that do not say what their axes are.

    Raises
    ------
    FileError
        If it cannot be read.
    """
    start = _start(path)
    if is_metaimage(start) or is_nrrd(start):
        return b"Seq_Frame" not in start
    return is_nifti(Path(path), start)


def _start(path: PathLike) -> bytes:
    with reading(path), open_regular(path) as stream:
        return stream.read(_SNIFFED_BYTES)


def read_volume(path: PathLike) -> Volume:
    """Read a volume; numbers of a type that is none of `VOXEL_TYPES` become float32.

    Files that say that they are of labels give a `LabelMap`. A left-handed grid is turned into a right-handed
    one by counting k from its other end.

    Parameters
    ----------
    path : path
        NRRD, MetaImage or NIfTI.

    Returns
    -------
    Volume

    Raises
    ------
    FileError
        If the file is missing, truncated or of no known format.
    InvalidInputError
        If it is not a grey three-dimensional image.
    """
    start = _start(path)
    if is_nifti(Path(path), start):
        voxels, matrix, fields, is_labels = read_nifti(Path(path))
        own = {name: text for name, text in fields.items() if not is_segmentation({name: text})}
    elif is_metaimage(start) or is_nrrd(start):
        header = read_header(path)
        fields, own, is_labels = header.fields, own_fields(header.fields), is_segmentation(header.fields)
        if fields.get("ElementNumberOfChannels", "1") != "1":
            raise InvalidInputError(f"{path}: expected a grey image, got more than one value per pixel")
        voxels = read_pixels(header.pixels)
        if len(header.size) != 3 or voxels.size != np.prod(header.size, dtype=object):
            got = f"{len(header.size)} axes {header.size} of {voxels.size} numbers"
            raise InvalidInputError(f"{path}: expected a grey image of three axes, got {got}")
        # The first axis runs fastest in a file.
        voxels = voxels.reshape(header.size[::-1]).T
        matrix = _meta_matrix(header) if is_metaimage(start) else _nrrd_matrix(header)
    else:
        raise InvalidInputError(
            f"{path}: expected NRRD, MetaImage or NIfTI (.nii.gz, .nii, .hdr), got something else"
        )
    if voxels.ndim != 3 or not voxels.size or voxels.dtype.kind not in "iuf":
        got = f"shape {voxels.shape} of {voxels.dtype}"
        raise InvalidInputError(f"{path}: expected a grey image of three axes, got {got}")
    voxels = voxels.astype(voxels.dtype.newbyteorder("="), copy=False)
    with naming(str(path)):
        voxels, spacing, pose = _placed(voxels, matrix)
        if is_labels:
            return LabelMap(_labels(voxels), spacing, pose, own, read_segments(fields, str(path)))
        return Volume(
            voxels if voxels.dtype.name in VOXEL_TYPES else voxels.astype(np.float32), spacing, pose, own
        )


load_volume = read_volume
"""Its public name, `speckle3d.load_volume`."""


def read_states(path: PathLike, volume: Volume) -> ByteArray:
    """Read the states of a volume's voxels, as ``speckle3d volume --state`` writes them.

    Returns
    -------
    ndarray of uint8, shape (n_i, n_j, n_k)
        `EMPTY`, `MEASURED` or `FILLED`; see `speckle3d.core.labels`.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If it holds no states, or not those of a volume of this shape and place.
    """
    states = read_volume(path)
    if states.voxels.dtype != np.uint8 or states.shape != volume.shape:
        wanted = " x ".join(str(n) for n in volume.shape)
        raise InvalidInputError(
            f"{path}: expected states on the volume's grid, uint8 of {wanted} voxels, got "
            f"{states.voxels.dtype} of {' x '.join(str(n) for n in states.shape)}"
        )
    if not np.allclose(states.world_from_index, volume.world_from_index, atol=_SAME_PLACE_MM):
        raise InvalidInputError(f"{path}: expected states on the volume's grid, got some of another place")
    return states.voxels


def _placed(
    voxels: npt.NDArray[Any], world_from_index: FloatArray
) -> tuple[npt.NDArray[Any], tuple[float, float, float], RigidTransform]:
    """Voxels of a right-handed grid, its spacing and its pose."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # what is not finite is refused
        matrix = np.array(world_from_index, dtype=float)
        spacing = np.linalg.norm(matrix[:3, :3], axis=0)
        if not (np.isfinite(spacing).all() and (spacing > 0).all()):
            raise InvalidInputError(f"spacing: expected lengths above zero, got {spacing.tolist()}")
        if np.linalg.det(matrix[:3, :3]) < 0:
            matrix[:3, 3] += matrix[:3, 2] * (voxels.shape[2] - 1)
            matrix[:3, 2] *= -1.0
            voxels = voxels[:, :, ::-1]
        matrix[:3, :3] /= spacing
    pose: RigidTransform = transforms_from_matrices(matrix[None], "direction")[0]
    return voxels, tuple(spacing.tolist()), pose


def _labels(voxels: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Labels as whole numbers of two bytes at most."""
    if voxels.dtype.name in LABEL_TYPES:
        return voxels
    with np.errstate(invalid="ignore"):
        labels = voxels.astype(np.uint16)
    if not np.array_equal(labels, voxels):
        raise InvalidInputError("labels: expected whole numbers from 0 to 65535, got others")
    return labels


def _meta_matrix(header: SequenceHeader) -> FloatArray:
    """World (LPS, mm) from index of a MetaImage."""
    spacing = _of_field(header, ("ElementSpacing", "ElementSize"), np.ones(3))
    axes = _of_field(header, ("TransformMatrix", "Rotation", "Orientation"), np.eye(3).ravel())
    matrix = np.eye(4)
    matrix[:3, :3] = axes.reshape(3, 3).T * spacing
    matrix[:3, 3] = _of_field(header, ("Offset", "Position", "Origin"), np.zeros(3))
    matrix[:3] *= _mm_of(header, header.fields.get("DistanceUnits", ""))
    return matrix


def _of_field(header: SequenceHeader, names: tuple[str, ...], default: FloatArray) -> FloatArray:
    name = next((name for name in names if name in header.fields), None)
    if name is None:
        return default
    return np.array(numbers(header.fields[name], default.size, f"{header.path}: {name}"))


def _nrrd_matrix(header: SequenceHeader) -> FloatArray:
    """World (LPS, mm) from index of an NRRD file."""
    fields, where, matrix = header.fields, header.path, np.eye(4)
    if "space directions" in fields:
        matrix[:3, :3] = _vectors(fields["space directions"], 3, f"{where}: space directions").T
        units = fields.get("space units", "")
    else:
        matrix[:3, :3] = np.diag(_of_field(header, ("spacings",), np.ones(3)))
        units = fields.get("units", "")
    if "space origin" in fields:
        matrix[:3, 3] = _vectors(fields["space origin"], 1, f"{where}: space origin")[0]
    words = {word.strip().lower() for word in re.findall(r'"([^"]*)"', units)} or {""}
    if len(words) > 1:
        raise InvalidInputError(f"{where}: expected one unit for all axes, got {units}")
    signs = _TO_LPS.get(fields.get("space", "").lower(), (1, 1, 1))
    matrix[:3] *= np.array(signs)[:, None] * _mm_of(header, words.pop())
    return matrix


def _mm_of(header: SequenceHeader, unit: str) -> float:
    if unit.lower() not in _MM:
        known = ", ".join(word for word in _MM if word)
        raise InvalidInputError(f"{header.path}: expected a unit among {known}, got {unit!r}")
    return _MM[unit.lower()]


def _vectors(text: str, count: int, where: str) -> FloatArray:
    rows = [numbers(row.replace(",", " "), 3, where) for row in re.findall(r"\(([^)]*)\)", text)]
    if len(rows) != count:
        raise InvalidInputError(f"{where}: expected {count} vector(s) of three numbers, got {text[:40]!r}")
    return np.array(rows)
