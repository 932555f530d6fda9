"""Volumes as NRRD, MetaImage or NIfTI files: written by SimpleITK; read here, which survives damage."""

from __future__ import annotations

import gzip
import os
import re
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import FileError, InvalidInputError, naming
from speckle3d.core.files import PathLike, open_regular
from speckle3d.core.geometry import transforms_from_matrices
from speckle3d.core.volume import Volume
from speckle3d.io.hdf5 import atomic_path, one_line, reading
from speckle3d.io.headers import SequenceHeader, image_library, is_metaimage, is_nrrd, read_header
from speckle3d.io.pixels import Pixels, read_pixels
from speckle3d.io.text import numbers

SUFFIXES = (".nrrd", ".mha", ".nii.gz")

_GZIP_SIGNATURE = b"\x1f\x8b"
_STDERR = 2
_HEADER_BYTES = 4096
"""More than the header of an NRRD file that ITK writes."""
_PIECE_BYTES = 2**20
_SNIFFED_BYTES = 512

_TO_LPS = {"left-anterior-superior": (1, -1, 1), "right-anterior-superior": (-1, -1, 1)}
"""Signs that turn a space of NRRD into the one of MetaImage and this package; others stay as they are."""
_SPACES = {"las": "left-anterior-superior", "ras": "right-anterior-superior"}

_NIFTI_BYTES = 348
_NIFTI_TYPES = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4"}


def write_volume(path: PathLike, volume: Volume, compress: bool = True) -> None:
    """Write a volume whole or not at all; the suffix chooses the format.

    World axes are written as they are, in mm. NIfTI readers see the first two reversed (RAS against LPS), as
    in every file that passes through ITK.

    Raises
    ------
    InvalidInputError
        If the suffix is not one of `SUFFIXES`.
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
    if not Path(path).name.lower().endswith(SUFFIXES):
        raise InvalidInputError(f"{path}: expected a name ending in {', '.join(SUFFIXES)}")
    with atomic_path(path) as part:
        with image_library(path, "written") as itk, _silence():
            try:
                itk.WriteImage(_to_image(itk, volume), str(part), useCompression=compress)
            except RuntimeError:
                _require_room(part)
                raise
        # ITK does not notice a disk that fills up while it packs, or with its last bytes.
        if not _holds(part, volume):
            _require_room(part)
            raise FileError(f"{path}: cannot be written: it was cut short")


@dataclass(frozen=True)
class _Stored:
    """Voxels as a file holds them.

    Attributes
    ----------
    spacing_mm : ndarray, shape (3,)
    axes : ndarray, shape (3, 3)
        Directions of the grid's axes in the world, a row each.
    origin_mm : ndarray, shape (3,)
    """

    size: tuple[int, ...]
    voxels: npt.NDArray[Any]
    spacing_mm: FloatArray
    axes: FloatArray
    origin_mm: FloatArray

    @classmethod
    def of_steps(
        cls, size: tuple[int, ...], voxels: npt.NDArray[Any], steps_mm: FloatArray, origin_mm: FloatArray
    ) -> _Stored:
        """Take spacing and directions from the steps to the next voxel along each axis, a row each."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            spacing = np.linalg.norm(steps_mm, axis=1)
            return cls(size, voxels, spacing, steps_mm / spacing[:, None], origin_mm)


def read_volume(path: PathLike) -> Volume:
    """Read a volume; other number types than uint8 become float32.

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
    if start.startswith(_GZIP_SIGNATURE):
        found = _nifti(Path(path), size_bytes)
    elif is_metaimage(start) or is_nrrd(start):
        header = read_header(path)
        found = _meta(header) if is_metaimage(start) else _nrrd(header)
    else:
        raise InvalidInputError(f"{path}: expected NRRD, MetaImage or NIfTI (.nii.gz), got something else")
    if len(found.size) != 3 or found.voxels.size != np.prod(found.size, dtype=object):
        got = f"{len(found.size)} axes {found.size} of {found.voxels.size} numbers"
        raise InvalidInputError(f"{path}: expected a grey image of three axes, got {got}")
    with naming(str(path)):
        return _volume(found)


@contextmanager
def _silence() -> Iterator[None]:
    """Keep MetaIO's own words off stderr: it prints a line there on top of the exception."""
    told, nowhere = os.dup(_STDERR), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, _STDERR)
    try:
        yield
    finally:
        os.dup2(told, _STDERR)
        os.close(told)
        os.close(nowhere)


def _holds(path: Path, volume: Volume) -> bool:
    """Whether a file that was just written has all voxels, and the check sum behind them."""
    try:
        held = read_volume(path).voxels
        with open(path, "rb") as stream:
            header = stream.read(_HEADER_BYTES).partition(b"\n\n")[0]
            if path.name.lower().endswith(".gz") or b"\nencoding: gz" in header:
                stream.seek(0 if header.startswith(_GZIP_SIGNATURE) else len(header) + 2)
                with gzip.open(stream) as unpacked:
                    while unpacked.read(_PIECE_BYTES):
                        pass
    except (FileError, InvalidInputError, EOFError, zlib.error, gzip.BadGzipFile):
        return False
    return np.array_equal(held, volume.voxels.astype(held.dtype), equal_nan=True)


def _require_room(part: Path) -> None:
    """Raise the system's own `OSError` if a file that was not written whole can take no more."""
    with open(part, "ab") as stream:
        stream.write(bytes(_PIECE_BYTES))


def _to_image(itk: Any, volume: Volume) -> Any:
    image: Any = itk.GetImageFromArray(np.ascontiguousarray(volume.voxels.T))
    image.SetSpacing(volume.spacing_mm)
    image.SetOrigin(volume.world_from_grid.translation.tolist())
    image.SetDirection(volume.world_from_grid.rotation.as_matrix().ravel().tolist())
    return image


def _volume(found: _Stored) -> Volume:
    spacing = found.spacing_mm
    if not (np.isfinite(spacing).all() and (spacing > 0).all()):
        raise InvalidInputError(f"spacing: expected lengths above zero, got {spacing.tolist()}")
    matrix = np.eye(4)
    matrix[:3, :3] = found.axes.T
    matrix[:3, 3] = found.origin_mm
    pose: RigidTransform = transforms_from_matrices(matrix[None], "direction")[0]
    kept = found.voxels if found.voxels.dtype == np.uint8 else found.voxels.astype(np.float32)
    # The first axis runs fastest in a file.
    voxels = np.ascontiguousarray(kept.reshape(found.size[::-1]).T)
    return Volume(voxels, tuple(spacing.tolist()), pose)


def _meta(header: SequenceHeader) -> _Stored:
    fields, count = header.fields, len(header.size)
    spacing = _of_field(header, ("ElementSpacing", "ElementSize"), count, np.ones(count))
    axes = _of_field(header, ("TransformMatrix", "Rotation", "Orientation"), count**2, np.eye(count).ravel())
    origin = _of_field(header, ("Offset", "Position", "Origin"), count, np.zeros(count))
    if int(fields.get("ElementNumberOfChannels", "1")) != 1:
        raise InvalidInputError(f"{header.path}: expected a grey image, got more than one value per pixel")
    return _Stored(header.size, read_pixels(header.pixels), spacing, axes.reshape(count, count), origin)


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
    return _Stored.of_steps(header.size, read_pixels(header.pixels), axes * signs, origin[0] * signs)


def _vectors(text: str, count: int, where: str) -> FloatArray:
    rows = [numbers(v.replace(",", " "), None, where) for v in re.findall(r"\(([^)]*)\)", text)]
    if len(rows) != count or len({len(row) for row in rows}) != 1:
        raise InvalidInputError(f"{where}: expected {count} vectors of one length, got {text[:40]!r}")
    return np.array(rows)


def _nifti(path: Path, size_bytes: int) -> _Stored:
    """Read a NIfTI-1 file in gzip; its world is right, anterior, superior."""
    head = _unpacked_head(path)
    if len(head) < _NIFTI_BYTES or head[344:347] != b"n+1":
        raise FileError(f"{path}: expected NIfTI in gzip (.nii.gz), got something else, or a truncated one")
    order = "<" if head[:4] == struct.pack("<i", _NIFTI_BYTES) else ">"
    dimensions = struct.unpack(f"{order}8h", head[40:56])
    kind, _ = struct.unpack(f"{order}2h", head[70:74])
    pixdim = np.array(struct.unpack(f"{order}8f", head[76:108]))
    start, slope, offset = struct.unpack(f"{order}3f", head[108:120])
    size = tuple(dimensions[1 : 1 + max(dimensions[0], 0)])
    while len(size) > 3 and size[-1] == 1:
        size = size[:-1]
    whole = np.isfinite(start) and start == int(start) and _NIFTI_BYTES <= start <= 2**30
    if len(size) != 3 or min(size) < 1 or kind not in _NIFTI_TYPES or not whole:
        got = f"{len(size)} axes {size}, type {kind}, voxels from byte {start:g}"
        raise InvalidInputError(f"{path}: expected a grey NIfTI image of three axes, got {got}")
    dtype = np.dtype(order + _NIFTI_TYPES[kind])
    skipped = int(start)
    count = int(np.prod(size, dtype=np.int64)) * dtype.itemsize + skipped
    data = read_pixels(Pixels(path, 0, size_bytes, np.dtype(np.uint8), count, "deflate"))
    voxels = data[skipped:].copy().view(dtype).astype(dtype.newbyteorder("="), copy=False)
    if slope != 0 and (slope, offset) != (1, 0):
        voxels = (voxels * np.float32(slope) + np.float32(offset)).astype(np.float32)
    axes, origin = _nifti_pose(head, order, pixdim)
    to_lps = np.array([-1.0, -1.0, 1.0])
    return _Stored.of_steps(size, voxels, axes * to_lps, origin * to_lps)


def _nifti_pose(head: bytes, order: str, pixdim: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Axes, a row each, and origin: by the matrix (sform), else by the quaternion (qform)."""
    by_quaternion, by_matrix = struct.unpack(f"{order}2h", head[252:256])
    if by_matrix > 0:
        matrix = np.array(struct.unpack(f"{order}12f", head[280:328])).reshape(3, 4)
        return matrix[:, :3].T, matrix[:, 3]
    if by_quaternion <= 0:
        return np.diag(pixdim[1:4]), np.zeros(3)
    b, c, d, *origin = struct.unpack(f"{order}6f", head[256:280])
    a = np.sqrt(max(0.0, 1.0 - b * b - c * c - d * d))
    turn = Rotation.from_quat([a, b, c, d], scalar_first=True).as_matrix()
    turn[:, 2] *= -1.0 if pixdim[0] < 0 else 1.0
    return (turn * pixdim[1:4]).T, np.array(origin)


def _unpacked_head(path: Path) -> bytes:
    with reading(path), open_regular(path) as stream:
        try:
            return zlib.decompressobj(47).decompress(stream.read(2**16), _NIFTI_BYTES)
        except zlib.error as error:
            raise FileError(f"{path}: expected a whole gzip file: {one_line(error)}") from error
