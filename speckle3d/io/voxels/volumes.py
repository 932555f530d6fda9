"""Volumes and label maps as NRRD, MetaImage or NIfTI files.

World axes are written as left, posterior, superior (LPS), mm.

References
----------
.. [1] G. Kindlmann, "Definition of NRRD File Format", teem.sourceforge.net.
.. [2] MetaIO documentation, Insight Software Consortium.
.. [3] 3D Slicer developer guide, "Segmentation labelmap file format (.seg.nrrd)".
"""

import json
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import AnyArray, ByteArray, FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.files import PathLike
from speckle3d.core.geometry import transforms_from_matrices
from speckle3d.core.text import printable
from speckle3d.core.volume import VOXEL_TYPES, LabelMap, Segment, Volume
from speckle3d.io.hdf5 import LABELS_ALONE, atomic_path, reading, require_suffix
from speckle3d.io.images.headers import RAS_FROM_LPS, is_image, mm_per, read_header, write_image
from speckle3d.io.readers import first_bytes
from speckle3d.io.text import number_text, numbers, unescape

SUFFIXES = (".nrrd", ".mha", ".nii.gz", ".nii")
"""Of files that are written; labels may have .seg.nrrd, too."""
_PREFIX = "Speckle3D_"
"""Before the names of a volume's fields, so that none is taken for one of the format's own."""
_LABELS, _COMMENT = "label", "speckle3d"
"""NIfTI's intent of an image of labels, and the name of fields in its comment."""
_SEGMENTATION = """\
Segmentation_ContainedRepresentationNames=Binary labelmap|
Segmentation_MasterRepresentation=Binary labelmap
Segmentation_SourceRepresentation=Binary labelmap
Segmentation_ReferenceImageExtentOffset=0 0 0
"""
"""Fields of labels as Slicer calls them [3]_; before its version 5.2 the source was called master."""
_SIZES = {size.to_bytes(4, order) for size in (348, 540) for order in ("little", "big")}
"""First bytes of NIfTI-1 and NIfTI-2: the length of the header."""
_SEGMENT = re.compile(r"Segment(?:ation|(\d{1,5}))_(\w+)")
_UNNAMED_COLOUR = "0.5 0.5 0.5"
"""Fields of Slicer's labels, and a colour where they have none."""
_SAME_PLACE_MM = 1e-3
"""Two grids are one if they differ by less: NIfTI keeps places to single precision."""


def is_volume(path: PathLike) -> bool:
    """Whether a file says that it is a volume: NIfTI, or an image whose axes are all of space.

    Raises
    ------
    FileError, InvalidInputError
        If it cannot be read, or its header does not make sense.
    """
    start = first_bytes(path)
    return read_header(path).is_volume if is_image(start) else is_nifti(Path(path), start)


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
    start, file = first_bytes(path), Path(path)
    if not (is_image(start) or is_nifti(file, start)):
        raise InvalidInputError(
            f"{path}: expected NRRD, MetaImage or NIfTI (.nii.gz, .nii, .hdr), got something else"
        )
    voxels, matrix, fields, is_labels = (_read_image if is_image(start) else _read_nifti)(file)
    if voxels.ndim != 3 or not voxels.size or voxels.dtype.kind not in "iuf":
        raise InvalidInputError(
            f"{path}: expected a grey image of three axes, got shape {voxels.shape} of {voxels.dtype}"
        )
    remarks = {name: text for name, text in fields.items() if not _SEGMENT.fullmatch(name)}
    with naming(str(path)):
        voxels, spacing, pose = _right_handed(
            voxels.astype(voxels.dtype.newbyteorder("="), copy=False), matrix
        )
        if is_labels:
            segments = tuple(_read_segments(fields, str(path)))
            return LabelMap(_labels(voxels), spacing, pose, remarks, segments)
        if voxels.dtype.name not in VOXEL_TYPES:
            voxels = voxels.astype(np.float32)
        return Volume(voxels, spacing, pose, remarks)


load_volume = read_volume
"""Its public name, `speckle3d.load_volume`."""


def read_states(path: PathLike, volume: Volume) -> ByteArray:
    """Read the states of a volume's voxels, as ``speckle3d volume --state`` writes them.

    Returns
    -------
    ndarray of uint8, shape (n_i, n_j, n_k)
        `EMPTY`, `MEASURED` or `FILLED`; see `speckle3d.core.volume`.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If it holds no states, or not those of a volume of this shape and place.
    """
    states = read_volume(path)
    is_there = states.shape == volume.shape and np.allclose(
        states.world_from_index, volume.world_from_index, atol=_SAME_PLACE_MM
    )
    if states.voxels.dtype != np.uint8 or not is_there:
        raise InvalidInputError(
            f"{path}: expected states (uint8) on the volume's {volume.shape}, got {states.voxels.dtype}, "
            f"shape {states.shape}{'' if is_there else ', elsewhere'}"
        )
    return states.voxels


def _right_handed(
    voxels: AnyArray, world_from_index: FloatArray
) -> tuple[AnyArray, tuple[float, float, float], RigidTransform]:
    """Voxels of a right-handed grid, its spacing and its pose."""
    matrix = np.array(world_from_index, dtype=float)
    with np.errstate(all="ignore"):  # what is not finite is refused
        spacing = np.linalg.norm(matrix[:3, :3], axis=0)
        if np.linalg.det(matrix[:3, :3]) < 0:
            matrix[:3, 3] += matrix[:3, 2] * (voxels.shape[2] - 1)
            matrix[:3, 2] *= -1.0
            voxels = voxels[:, :, ::-1]
        matrix[:3, :3] /= spacing
    pose: RigidTransform = transforms_from_matrices(matrix[None], "direction")[0]
    return voxels, tuple(spacing.tolist()), pose


def _read_segments(fields: Mapping[str, str], where: str) -> Iterator[Segment]:
    """Read what labels mean; those without a name or colour get one.

    Raises
    ------
    InvalidInputError
        Naming the field that does not make sense, or of a file whose segments overlap.
    """
    rows = defaultdict[int, dict[str, str]](dict)
    for name, value in fields.items():
        if (match := _SEGMENT.fullmatch(name)) and match[1]:
            rows[int(match[1])][match[2]] = value
    for i, row in sorted(rows.items()):
        place = f"{where}: Segment{i}"
        (label,) = numbers(row.get("LabelValue", "1"), 1, f"{place}_LabelValue")
        red, green, blue = numbers(row.get("Color", _UNNAMED_COLOUR), 3, f"{place}_Color")
        if label % 1 or row.get("Layer", "0") != "0":
            raise InvalidInputError(
                f"{place}: expected a whole LabelValue in Layer 0, got {label} in another"
            )
        name = row.get("Name") or row.get("ID") or f"Segment {i}"
        yield Segment(int(label), name, (red, green, blue))


def _labels(voxels: AnyArray) -> AnyArray:
    """Labels as whole numbers of two bytes at most."""
    with np.errstate(invalid="ignore"):
        labels = voxels if voxels.dtype == np.uint8 else voxels.astype(np.uint16)
    if not np.array_equal(labels, voxels):
        raise InvalidInputError("labels: expected whole numbers from 0 to 65535, got others")
    return labels


def is_nifti(path: Path, start: bytes) -> bool:
    """Whether a file is NIfTI by its first bytes; one packed by gzip, by its name."""
    return start[:4] in _SIZES or (start.startswith(b"\x1f\x8b") and path.name.lower().endswith(".nii.gz"))


def _read_image(path: Path) -> tuple[AnyArray, FloatArray, dict[str, str], bool]:
    """Voxels of a MetaImage or NRRD image, their LPS world from index in mm, fields, and if labels."""
    header, matrix = read_header(path), np.eye(4)
    axes = np.eye(3) if header.axes_mm is None else header.axes_mm
    origin = np.zeros(3) if header.origin_mm is None else header.origin_mm
    if len(header.size) != 3 or axes.shape != (3, 3) or origin.size != 3:
        lengths = " x ".join(map(str, header.size))
        raise InvalidInputError(
            f"{path}: expected three axes in space, got {lengths}, an origin of {origin.size} numbers"
        )
    matrix[:3, :3], matrix[:3, 3] = axes.T, origin
    # The first axis runs fastest in a file; a mapped file may be replaced while voxels are used.
    shape = (*header.size[::-1], *[header.channels] * (header.channels > 1))
    names = [name for name in header.fields if name.startswith(_PREFIX) or _SEGMENT.fullmatch(name)]
    fields = {name.removeprefix(_PREFIX): unescape(header.fields[name]) for name in names}
    is_labels = header.dtype.kind != "f" and any(map(_SEGMENT.fullmatch, fields))
    return np.array(header.numbers()).reshape(shape).T, matrix, fields, is_labels


def _read_nifti(path: Path) -> tuple[AnyArray, FloatArray, dict[str, str], bool]:
    """Voxels of NIfTI-1 or NIfTI-2, their LPS world from index in mm, this package's fields, and if labels.

    The header's unit counts; a header without one means mm.
    """
    import nibabel

    with naming(str(path)), reading(path, Exception):
        image: Any = nibabel.load(path)
        voxels = np.asanyarray(image.dataobj)
        factor = mm_per(image.header.get_xyzt_units()[0])
        is_labels = image.header.get_intent()[0] == _LABELS
    while voxels.ndim > 3 and voxels.shape[-1] == 1:
        voxels = voxels[..., 0]
    affine = np.diag([factor, factor, factor, 1.0]) @ RAS_FROM_LPS @ image.affine
    fields: dict[str, str] = {}
    for extension in image.header.extensions:
        with suppress(ValueError, LookupError, TypeError, AttributeError):  # of somebody else
            fields |= json.loads(bytes(extension.get_content()).rstrip(b"\0"))[_COMMENT]
    return voxels, affine, fields, is_labels


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
        If the suffix is none of `SUFFIXES`.
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
    plain = _segment_fields(volume.segments, volume.shape) if isinstance(volume, LabelMap) else {}
    suffix = require_suffix(path, (LABELS_ALONE, *SUFFIXES) if plain else SUFFIXES)
    with atomic_path(path) as part:
        if ".nii" in suffix:
            _write_nifti(part, volume, {**volume.fields, **plain})
            return
        named = {f"{_PREFIX}{name}": value for name, value in volume.fields.items()} | plain
        fields = {name: _escape(value) for name, value in named.items()}
        axes = (_meta_axes if suffix == ".mha" else _nrrd_axes)(volume)
        write_image(part, volume.voxels.T, volume.shape, volume.voxels.dtype, axes, fields, compress)


def _segment_fields(segments: Sequence[Segment], shape: Sequence[int]) -> dict[str, str]:
    """Header fields of a label map and its segments, all in one layer of the whole grid."""
    extent, text = " ".join(f"0 {length - 1}" for length in shape), _SEGMENTATION
    for i, segment in enumerate(segments):
        text += f"""Segment{i}_ID=Segment_{segment.value}
Segment{i}_NameAutoGenerated=0
Segment{i}_Color={number_text(segment.colour)}
Segment{i}_ColorAutoGenerated=0
Segment{i}_Extent={extent}
Segment{i}_LabelValue={segment.value}
Segment{i}_Layer=0
"""
    names = {f"Segment{i}_Name": segment.name for i, segment in enumerate(segments)}
    return names | dict(line.split("=") for line in text.splitlines())


def _write_nifti(path: Path, volume: Volume, fields: Mapping[str, str]) -> None:
    import nibabel

    # NIfTI-1 counts voxels along an axis by two bytes.
    kind: Any = nibabel.Nifti2Image if max(volume.shape) >= 2**15 else nibabel.Nifti1Image
    image = kind(volume.voxels, RAS_FROM_LPS @ volume.world_from_index)
    image.set_qform(image.affine, 1)
    image.set_sform(image.affine, 1)
    image.header.set_xyzt_units("mm")
    if isinstance(volume, LabelMap):
        image.header.set_intent(_LABELS)
    if fields:
        text = json.dumps({_COMMENT: dict(fields)}, ensure_ascii=False).encode("utf-8", "backslashreplace")
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
