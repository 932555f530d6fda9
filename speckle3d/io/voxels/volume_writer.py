"""Volumes written plane by plane as NRRD, MetaImage or NIfTI files.

World axes are written as left, posterior, superior (LPS), mm.

References
----------
.. [1] G. Kindlmann, "Definition of NRRD File Format", teem.sourceforge.net.
.. [2] MetaIO documentation, Insight Software Consortium.
.. [3] 3D Slicer developer guide, "Segmentation labelmap file format (.seg.nrrd)".
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import nibabel
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import AnyArray
from speckle3d.core.errors import MismatchError
from speckle3d.core.files import PathLike
from speckle3d.core.text import printable
from speckle3d.core.volume import LabelMap, Segment, Volume
from speckle3d.io.hdf5 import LABELS_ALONE, atomic_path, require_suffix
from speckle3d.io.images.image_writer import write_image
from speckle3d.io.text import number_text

SUFFIXES = (".nrrd", ".mha", ".nii.gz", ".nii")
"""Of files that are written; labels may have .seg.nrrd, too."""

PREFIX = "Speckle3D_"
"""Before the names of a volume's fields, so that none is taken for one of the format's own."""

RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
"""World of NIfTI from that of the other formats."""
LABELS, COMMENT = "label", "speckle3d"
"""NIfTI's intent of an image of labels, and the name of fields in its comment."""


_REPRESENTATION = "Binary labelmap"
"""Of labels, as Slicer calls them [3]_."""


def write_volume(path: PathLike, volume: Volume, compress: bool = True) -> None:
    """Write a volume whole or not at all; the suffix chooses the format.

    World axes are written as left, posterior, superior, in mm: NRRD says so, MetaImage means it, and NIfTI
    has the first two reversed (right, anterior, superior). Numbers are little-endian.

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
    >>> from speckle3d.io.voxels.volumes import read_volume
    >>> volume = Volume(np.zeros((4, 3, 2), np.uint8), (0.5, 0.5, 1.0), RigidTransform.identity())
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_volume(f"{folder}/v.nrrd", volume)
    ...     read_volume(f"{folder}/v.nrrd").shape
    (4, 3, 2)
    """
    is_labels = isinstance(volume, LabelMap)
    suffix = require_suffix(path, (LABELS_ALONE, *SUFFIXES) if is_labels else SUFFIXES)
    plain = _segment_fields(volume.segments, volume.shape) if isinstance(volume, LabelMap) else {}
    with atomic_path(path) as part:
        if ".nii" in suffix:
            _write_nifti(part, volume, {**volume.fields, **plain}, is_labels)
            return
        named = {f"{PREFIX}{name}": value for name, value in volume.fields.items()} | plain
        fields = {name: _escape(value) for name, value in named.items()}
        axes = (_meta_axes if suffix == ".mha" else _nrrd_axes)(volume)
        write_image(part, volume.voxels.T, volume.shape, volume.voxels.dtype, axes, fields, compress)


class VolumeWriter:
    """Takes the planes of a volume in a block and writes it as `write_volume` does when the block ends.

    Parameters
    ----------
    path : path
        With a suffix of `SUFFIXES`.
    shape : tuple of int
        Number of voxels along i, j and k.
    spacing_mm : tuple of float
        Distance between neighbouring voxel centres along i, j and k.
    world_from_grid : RigidTransform
        Pose of the grid; its origin is the centre of voxel ``[0, 0, 0]``; mm.
    dtype : dtype
        uint8, int16, uint16 or float32.
    fields : mapping of str to str, optional
        What the file says of the voxels; `read_volume` gives it back.
    compress : bool
        Whether voxels are packed with deflate; of .nii.gz, they always are, of .nii never.
    segments : sequence of Segment, optional
        What labels mean; voxels are labels if this is given, even if it is empty.

    Raises
    ------
    InvalidInputError
        If an argument is not what it must be.
    FileError
        If the file cannot be written; `NoSpaceError` if the disk is full.

    Examples
    --------
    >>> import tempfile
    >>> from speckle3d.io.voxels.volumes import read_volume
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = f"{folder}/v.nrrd"
    ...     with VolumeWriter(file, (4, 3, 2), (1, 1, 1), RigidTransform.identity(), "uint8") as writer:
    ...         for k in range(2):
    ...             writer.append(np.full((1, 3, 4), k, np.uint8))
    ...     read_volume(file).voxels[0, 0].tolist()
    [0, 1]
    """

    def __init__(
        self,
        path: PathLike,
        shape: tuple[int, int, int],
        spacing_mm: tuple[float, float, float],
        world_from_grid: RigidTransform,
        dtype: npt.DTypeLike,
        fields: Mapping[str, str] | None = None,
        compress: bool = True,
        segments: Sequence[Segment] | None = None,
    ) -> None:
        self._path, self._compress = path, compress
        place = np.zeros(shape, dtype, order="F"), spacing_mm, world_from_grid, dict(fields or {})
        self._volume = Volume(*place) if segments is None else LabelMap(*place, tuple(segments))
        self._rest = self._volume.voxels.T

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            if len(self._rest):
                raise MismatchError(f"{self._path}: expected {len(self._rest)} more planes")
            write_volume(self._path, self._volume, self._compress)

    def append(self, planes: AnyArray) -> None:
        """Take the next planes along k, shape (k, j, i), of the volume's type.

        Raises
        ------
        MismatchError
            If they are of another shape or type, or more than are left.
        """
        target = self._rest[: len(planes)]
        if (planes.shape, planes.dtype) != (target.shape, target.dtype):
            expected = f"planes of shape {target.shape}, {target.dtype}"
            raise MismatchError(f"{self._path}: expected {expected}, got {planes.shape}, {planes.dtype}")
        target[:] = planes
        self._rest = self._rest[len(planes) :]


def _segment_fields(segments: Iterable[Segment], shape: Sequence[int]) -> dict[str, str]:
    """Header fields of a label map and its segments, all in one layer of the whole grid."""
    extent = " ".join(f"0 {length - 1}" for length in shape)
    fields = {
        "Segmentation_ContainedRepresentationNames": f"{_REPRESENTATION}|",
        # Before Slicer 5.2 the same was called master.
        "Segmentation_MasterRepresentation": _REPRESENTATION,
        "Segmentation_SourceRepresentation": _REPRESENTATION,
        "Segmentation_ReferenceImageExtentOffset": "0 0 0",
    }
    for i, segment in enumerate(segments):
        row = {
            "ID": f"Segment_{segment.value}",
            "Name": segment.name,
            "NameAutoGenerated": "0",
            "Color": " ".join(f"{part:g}" for part in segment.colour),
            "ColorAutoGenerated": "0",
            "Extent": extent,
            "LabelValue": str(segment.value),
            "Layer": "0",
        }
        fields |= {f"Segment{i}_{name}": value for name, value in row.items()}
    return fields


def _write_nifti(path: Path, volume: Volume, fields: Mapping[str, str], is_labels: bool) -> None:
    # NIfTI-1 counts voxels along an axis by two bytes.
    kind: Any = nibabel.Nifti2Image if max(volume.shape) >= 2**15 else nibabel.Nifti1Image
    image = kind(volume.voxels, RAS_FROM_LPS @ volume.world_from_index)
    image.set_qform(image.affine, 1)
    image.set_sform(image.affine, 1)
    image.header.set_xyzt_units("mm")
    if is_labels:
        image.header.set_intent(LABELS)
    if fields:
        text = json.dumps({COMMENT: dict(fields)}, ensure_ascii=False).encode("utf-8", "backslashreplace")
        image.header.extensions.append(nibabel.nifti1.Nifti1Extension("comment", text))
    nibabel.save(image, path)


def _nrrd_axes(volume: Volume) -> str:
    *steps, origin = (f"({number_text(column, ',')})" for column in volume.world_from_index[:3].T)
    return f"""space: left-posterior-superior
space directions: {" ".join(steps)}
kinds: domain domain domain
space units: "mm" "mm" "mm"
space origin: {origin}"""


def _meta_axes(volume: Volume) -> str:
    """Kinds are as PLUS tells a volume from a sequence of frames."""
    pose = volume.world_from_grid
    return f"""Kinds = domain domain domain
TransformMatrix = {number_text(pose.rotation.as_matrix().T)}
Offset = {number_text(pose.translation)}
CenterOfRotation = 0 0 0
ElementSpacing = {number_text(volume.spacing_mm)}"""


def _escape(text: str) -> str:
    r"""Write text on one line, with line breaks and backslashes as NRRD has them: ``\n`` and ``\\``.

    Blanks at its ends are lost, and control characters are shown as Python writes them.
    """
    lines = printable(text.strip().replace("\r\n", "\n"), kept="\n")
    return lines.replace("\\", "\\\\").replace("\n", "\\n")
