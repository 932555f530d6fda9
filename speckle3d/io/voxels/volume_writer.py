"""Volumes written plane by plane, as NRRD, MetaImage or NIfTI files, in memory that stays as it is.

World axes are written as left, posterior, superior (LPS), mm.

References
----------
.. [1] G. Kindlmann, "Definition of NRRD File Format", teem.sourceforge.net.
.. [2] MetaIO documentation, Insight Software Consortium.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, MismatchError, naming
from speckle3d.core.files import PathLike
from speckle3d.core.labels import LabelMap, Segment
from speckle3d.core.printable import printable
from speckle3d.core.volume import Volume
from speckle3d.io.deflate import GZIP, ZLIB, packer
from speckle3d.io.hdf5 import atomic_path
from speckle3d.io.header_text import header_bytes, meta_start, put_packed_size
from speckle3d.io.pixels import meta_type, nrrd_type
from speckle3d.io.text import unescaped
from speckle3d.io.voxels.nifti import nifti_header
from speckle3d.io.voxels.segments import segment_fields

SUFFIXES = (".nrrd", ".mha", ".nii.gz", ".nii")
"""Of files that are written; .seg.nrrd is one of them, for labels alone."""

LABELS_ALONE = ".seg.nrrd"

PREFIX = "Speckle3D_"
"""Before the names of a volume's fields, so that none is taken for one of the format's own."""

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]*")


class VolumeWriter:
    """Writes a volume in a block; the file appears whole when the block ends, or not at all.

    World axes are written as left, posterior, superior, in mm: NRRD says so, MetaImage means it, and NIfTI
    has the first two reversed (right, anterior, superior). Numbers are little-endian.

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
        If an argument is not what it must be, naming the file.
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
        self._path, self._fields = Path(path), dict(fields or {})
        self._suffix = require_suffix(self._path, segments is not None)
        self._packs = self._suffix == ".nii.gz" or (compress and self._suffix != ".nii")
        with naming(str(path)):
            # Checked by the container, whose voxels are all one here.
            voxels = np.broadcast_to(np.zeros((), np.dtype(dtype).newbyteorder("=")), shape)
            place = voxels, spacing_mm, world_from_grid, self._fields
            volume = Volume(*place) if segments is None else LabelMap(*place, tuple(segments))
            if not np.isfinite(volume.world_from_index).all():
                raise InvalidInputError("world_from_grid: expected a finite pose, got another")
            for name in self._fields:
                if not _NAME.fullmatch(name):
                    raise InvalidInputError(
                        f"fields: expected names of letters, digits and '_.-' after a letter, got {name!r}"
                    )
            self._volume = volume
            self._header = self._made_header(volume, segments)
        self._planes = 0

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            part = stack.enter_context(atomic_path(self._path))
            self._file = stack.enter_context(part.open("wb"))
            stack.push(self._finish_unless)
            self._packer = packer(ZLIB if self._suffix == ".mha" else GZIP) if self._packs else None
            self._file.write(self._packed(self._header) if self._suffix == ".nii.gz" else self._header)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def append(self, planes: npt.NDArray[Any]) -> None:
        """Write the next planes along k.

        Parameters
        ----------
        planes : ndarray, shape (k, j, i)
            Of the volume's type, in any order in memory.

        Raises
        ------
        MismatchError
            If they are of another shape or type, or more than are left.
        FileError
            If the file cannot be written.
        """
        (n_i, n_j, n_k), dtype = self._volume.shape, self._volume.voxels.dtype
        left = n_k - self._planes
        if planes.ndim != 3 or planes.shape[1:] != (n_j, n_i) or len(planes) > left:
            expected = f"at most {left} planes of {n_j} x {n_i} voxels (j x i)"
            raise MismatchError(f"{self._path}: expected {expected}, got shape {planes.shape}")
        if planes.dtype.newbyteorder("=") != dtype:
            raise MismatchError(f"{self._path}: expected voxels of type {dtype}, got {planes.dtype}")
        for plane in planes:
            content = np.ascontiguousarray(plane, dtype.newbyteorder("<"))
            self._file.write(self._packed(content.data.cast("B")))
        self._planes += len(planes)

    def _packed(self, content: bytes | memoryview) -> Any:
        return content if self._packer is None else self._packer.compress(content)

    def _finish_unless(self, _: object, error: BaseException | None, __: object) -> None:
        if error is not None:
            return
        if self._planes != self._volume.shape[2]:
            raise MismatchError(f"{self._path}: expected {self._volume.shape[2]} planes, got {self._planes}")
        if self._packer is not None:
            self._file.write(self._packer.flush())
            if self._suffix == ".mha":
                put_packed_size(self._file, self._header, self._file.tell() - len(self._header))

    def _made_header(self, volume: Volume, segments: Sequence[Segment] | None) -> bytes:
        plain = {} if segments is None else segment_fields(segments, volume.shape)
        if ".nii" in self._suffix:
            return nifti_header(volume, {**self._fields, **plain}, segments is not None)
        fields = {f"{PREFIX}{name}": value for name, value in self._fields.items()} | plain
        escaped = {name: _escaped(value) for name, value in fields.items()}
        matrix = volume.world_from_index + 0.0  # no negative zeros
        return header_bytes((self._nrrd if self._suffix == ".nrrd" else self._meta)(matrix, escaped))

    def _nrrd(self, matrix: FloatArray, fields: Mapping[str, str]) -> list[str]:
        *steps, origin = (f"({_texts(column, ',')})" for column in matrix[:3].T)
        return [
            "NRRD0005",
            f"type: {nrrd_type(self._volume.voxels.dtype)}",
            "dimension: 3",
            "space: left-posterior-superior",
            f"sizes: {_texts(self._volume.shape)}",
            f"space directions: {' '.join(steps)}",
            "kinds: domain domain domain",
            "endian: little",
            f"encoding: {'gzip' if self._packs else 'raw'}",
            'space units: "mm" "mm" "mm"',
            f"space origin: {origin}",
            *(f"{name}:={value}" for name, value in fields.items()),
            "",
        ]

    def _meta(self, matrix: FloatArray, fields: Mapping[str, str]) -> list[str]:
        spacing = np.linalg.norm(matrix[:3, :3], axis=0)
        return [
            *meta_start(3, 0 if self._packs else None),
            f"TransformMatrix = {_texts((matrix[:3, :3] / spacing).T.ravel())}",
            f"Offset = {_texts(matrix[:3, 3])}",
            "CenterOfRotation = 0 0 0",
            f"ElementSpacing = {_texts(spacing)}",
            f"DimSize = {_texts(self._volume.shape)}",
            # As PLUS tells a volume from a sequence of frames.
            "Kinds = domain domain domain",
            *(f"{name} = {value}" for name, value in fields.items()),
            f"ElementType = MET_{meta_type(self._volume.voxels.dtype)}",
            "ElementDataFile = LOCAL",
        ]


def require_suffix(path: Path, is_labels: bool = False) -> str:
    """Suffix of a volume's name, which chooses the format.

    Raises
    ------
    InvalidInputError
        If it is none of `SUFFIXES`, or is of labels where there are none.
    """
    name = path.name.lower()
    suffix = next((each for each in SUFFIXES if name.endswith(each)), None)
    if suffix is None:
        raise InvalidInputError(f"{path}: expected a name ending in {', '.join(SUFFIXES)}")
    if name.endswith(LABELS_ALONE) and not is_labels:
        raise InvalidInputError(
            f"{path}: {LABELS_ALONE} is of labels with their segments: take another name ending in .nrrd"
        )
    return suffix


def own_fields(fields: Mapping[str, str]) -> dict[str, str]:
    """Fields of a volume among those in a header."""
    return {
        name.removeprefix(PREFIX): unescaped(value)
        for name, value in fields.items()
        if name.startswith(PREFIX) and name != PREFIX
    }


def _escaped(text: str) -> str:
    r"""Write text on one line, with line breaks and backslashes as NRRD has them: ``\n`` and ``\\``.

    Blanks at its ends are lost, and control characters are shown as Python writes them.
    """
    shown = printable(text.strip().replace("\r\n", "\n"), kept="\n")
    return shown.replace("\\", "\\\\").replace("\n", "\\n")


def _texts(values: Iterable[float], between: str = " ") -> str:
    return between.join(str(value) if isinstance(value, int) else repr(float(value)) for value in values)
