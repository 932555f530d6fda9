"""Volumes and label maps as NRRD, MetaImage or NIfTI files, read here so that damage is told in one line."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
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
from speckle3d.io.voxels.nifti import GZIP_SIGNATURE, NiftiImage, is_nifti, read_nifti
from speckle3d.io.voxels.segments import is_segmentation, read_segments
from speckle3d.io.voxels.volume_headers import own_fields
from speckle3d.io.voxels.volume_writer import VolumeWriter

_SNIFFED_BYTES = 4096

_SAME_PLACE_MM = 1e-3
"""Two grids are one if they differ by less: NIfTI keeps places to single precision."""

_TO_LPS = {"left-anterior-superior": (1, -1, 1), "right-anterior-superior": (-1, -1, 1)}
"""Signs that turn a space of NRRD into the one of MetaImage and this package; others stay as they are."""
_SPACES = {"las": "left-anterior-superior", "ras": "right-anterior-superior"}


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
    return _is_nifti_file(path, start)


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
    return _is_nifti_file(path, start)


def _start(path: PathLike) -> bytes:
    with reading(path), open_regular(path) as stream:
        return stream.read(_SNIFFED_BYTES)


def _is_nifti_file(path: PathLike, start: bytes) -> bool:
    return is_nifti(start) or (start.startswith(GZIP_SIGNATURE) and str(path).lower().endswith(".nii.gz"))


@dataclass(frozen=True)
class _Stored:
    """Voxels as a file holds them.

    Attributes
    ----------
    spacing_mm : ndarray, shape (3,)
    axes : ndarray, shape (3, 3)
        Directions of the grid's axes in the world, a row each.
    origin_mm : ndarray, shape (3,)
    fields : mapping of str to str
        All of the file's own.
    own : mapping of str to str
        Those of a volume of this package.
    is_labels : bool
    """

    size: tuple[int, ...]
    voxels: npt.NDArray[Any]
    spacing_mm: FloatArray
    axes: FloatArray
    origin_mm: FloatArray
    fields: Mapping[str, str] = field(default_factory=dict)
    own: Mapping[str, str] = field(default_factory=dict)
    is_labels: bool = False

    @classmethod
    def of_steps(
        cls,
        size: tuple[int, ...],
        voxels: npt.NDArray[Any],
        steps_mm: FloatArray,
        origin_mm: FloatArray,
        **others: Any,
    ) -> _Stored:
        """Take spacing and directions from the steps to the next voxel along each axis, a row each."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            spacing = np.linalg.norm(steps_mm, axis=1)
            return cls(size, voxels, spacing, steps_mm / spacing[:, None], origin_mm, **others)


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
    with reading(path), open_regular(path) as stream:
        start = stream.read(_SNIFFED_BYTES)
        size_bytes = stream.seek(0, 2)
    is_packed = start.startswith(GZIP_SIGNATURE)
    if is_packed or is_nifti(start):
        found = _nifti(read_nifti(Path(path), size_bytes, is_packed))
    elif is_metaimage(start) or is_nrrd(start):
        header = read_header(path)
        found = _meta(header) if is_metaimage(start) else _nrrd(header)
    else:
        raise InvalidInputError(
            f"{path}: expected NRRD, MetaImage or NIfTI (.nii.gz, .nii), got something else"
        )
    if len(found.size) != 3 or found.voxels.size != np.prod(found.size, dtype=object):
        got = f"{len(found.size)} axes {found.size} of {found.voxels.size} numbers"
        raise InvalidInputError(f"{path}: expected a grey image of three axes, got {got}")
    with naming(str(path)):
        return _volume(found, str(path))


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


def _volume(found: _Stored, where: str) -> Volume:
    spacing = found.spacing_mm
    if not (np.isfinite(spacing).all() and (spacing > 0).all()):
        raise InvalidInputError(f"spacing: expected lengths above zero, got {spacing.tolist()}")
    # The first axis runs fastest in a file.
    voxels = found.voxels.reshape(found.size[::-1]).T
    axes, origin = found.axes, found.origin_mm
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused below
        if np.linalg.det(axes) < 0:
            origin = origin + axes[2] * spacing[2] * (voxels.shape[2] - 1)
            axes, voxels = axes * [[1.0], [1.0], [-1.0]], voxels[:, :, ::-1]
    matrix = np.eye(4)
    matrix[:3, :3] = axes.T
    matrix[:3, 3] = origin
    pose: RigidTransform = transforms_from_matrices(matrix[None], "direction")[0]
    if found.is_labels:
        voxels = _labels(voxels)
        segments = read_segments(found.fields, where)
        return LabelMap(voxels, tuple(spacing.tolist()), pose, found.own, segments)
    kept = voxels if voxels.dtype.name in VOXEL_TYPES else voxels.astype(np.float32)
    return Volume(kept, tuple(spacing.tolist()), pose, found.own)


def _labels(voxels: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Labels as whole numbers of two bytes at most."""
    if voxels.dtype.name in LABEL_TYPES:
        return voxels
    found = voxels.astype(np.uint16)
    if not np.array_equal(found, voxels):
        raise InvalidInputError("labels: expected whole numbers from 0 to 65535, got others")
    return found


def _nifti(image: NiftiImage) -> _Stored:
    own = {name: text for name, text in image.fields.items() if not is_segmentation({name: text})}
    return _Stored.of_steps(
        image.size, image.voxels, image.steps_mm, image.origin_mm,
        fields=image.fields, own=own, is_labels=image.is_labels,
    )  # fmt: skip


def _text_fields(header: SequenceHeader) -> dict[str, Any]:
    fields = header.fields
    return {"fields": fields, "own": own_fields(fields), "is_labels": is_segmentation(fields)}


def _meta(header: SequenceHeader) -> _Stored:
    fields, count = header.fields, len(header.size)
    spacing = _of_field(header, ("ElementSpacing", "ElementSize"), count, np.ones(count))
    axes = _of_field(header, ("TransformMatrix", "Rotation", "Orientation"), count**2, np.eye(count).ravel())
    origin = _of_field(header, ("Offset", "Position", "Origin"), count, np.zeros(count))
    if int(fields.get("ElementNumberOfChannels", "1")) != 1:
        raise InvalidInputError(f"{header.path}: expected a grey image, got more than one value per pixel")
    voxels, axes = read_pixels(header.pixels), axes.reshape(count, count)
    return _Stored(header.size, voxels, spacing, axes, origin, **_text_fields(header))


def _of_field(header: SequenceHeader, names: Iterable[str], count: int, default: FloatArray) -> FloatArray:
    name = next((name for name in names if name in header.fields), None)
    if name is None:
        return default
    return np.array(numbers(header.fields[name], count, f"{header.path}: {name}"))


def _nrrd(header: SequenceHeader) -> _Stored:
    count, where = len(header.size), header.path
    if "space directions" in header.fields:
        axes = _vectors(header.fields["space directions"], count, f"{where}: space directions")
    else:
        axes = np.diag(_of_field(header, ("spacings",), count, np.ones(count)))
    origin = np.zeros((1, count))
    if "space origin" in header.fields:
        origin = _vectors(header.fields["space origin"], 1, f"{where}: space origin")
    if axes.shape != (count, count) or origin.shape != (1, count):
        raise InvalidInputError(f"{where}: expected directions and origin of {count} numbers, got others")
    space = header.fields.get("space", "").lower()
    signs = np.array(_TO_LPS.get(_SPACES.get(space, space), (1, 1, 1)))[:count]
    return _Stored.of_steps(
        header.size, read_pixels(header.pixels), axes * signs, origin[0] * signs, **_text_fields(header)
    )


def _vectors(text: str, count: int, where: str) -> FloatArray:
    rows = [numbers(v.replace(",", " "), None, where) for v in re.findall(r"\(([^)]*)\)", text)]
    if len(rows) != count or len({len(row) for row in rows}) != 1:
        raise InvalidInputError(f"{where}: expected {count} vectors of one length, got {text[:40]!r}")
    return np.array(rows)
