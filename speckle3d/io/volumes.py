"""Volumes as NRRD, MetaImage or NIfTI files, through SimpleITK."""

from __future__ import annotations

import gzip
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import FileError, InvalidInputError, naming
from speckle3d.core.geometry import transforms_from_matrices
from speckle3d.core.volume import Volume
from speckle3d.io.hdf5 import PathLike, atomic_path, one_line, reading
from speckle3d.io.headers import image_library, is_metaimage, is_nrrd, read_header

SUFFIXES = (".nrrd", ".mha", ".nii.gz")

_PIECE_BYTES = 2**20
_GZIP_SIGNATURE = b"\x1f\x8b"
_STDERR = 2
_HEADER_BYTES = 4096
"""More than the header of an NRRD file that ITK writes."""


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


def read_volume(path: PathLike) -> Volume:
    """Read a volume; other number types than uint8 become float32.

    Raises
    ------
    FileError
        If the file is missing, truncated or of no known format.
    InvalidInputError
        If it is not a grey three-dimensional image.
    """
    _require_whole(path)
    with image_library(path, "read") as itk:
        image = itk.ReadImage(str(path))
        # ITK's arrays run (k, j, i), slowest axis first.
        voxels = itk.GetArrayFromImage(image).T
    if image.GetDimension() != 3 or image.GetNumberOfComponentsPerPixel() != 1:
        raise InvalidInputError(
            f"{path}: expected a grey image of three axes, got {image.GetDimension()} axes and "
            f"{image.GetNumberOfComponentsPerPixel()} values per pixel"
        )
    with naming(str(path)):
        return _from_image(image, voxels)


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


def _from_image(image: Any, voxels: npt.NDArray[Any]) -> Volume:
    matrix = np.eye(4)
    matrix[:3, :3] = np.reshape(image.GetDirection(), (3, 3))
    matrix[:3, 3] = image.GetOrigin()
    pose: RigidTransform = transforms_from_matrices(matrix[None], "direction")[0]
    kept = voxels if voxels.dtype == np.uint8 else voxels.astype(np.float32)
    return Volume(np.ascontiguousarray(kept), image.GetSpacing(), pose)


def _require_whole(path: PathLike) -> None:
    """Refuse damaged files, which ITK fills with zeros or reports without naming them."""
    with reading(path), open(path, "rb") as stream:
        start = stream.read(512)
    if is_metaimage(start):
        read_header(path)
    elif start.startswith(_GZIP_SIGNATURE):
        _unpack(path)
    elif not is_nrrd(start):
        raise InvalidInputError(f"{path}: expected NRRD, MetaImage or NIfTI (.nii.gz), got something else")


def _unpack(path: PathLike) -> None:
    """Read a gzip file to its end, where it keeps its check sum."""
    try:
        with reading(path), gzip.open(path) as unpacked:
            while unpacked.read(_PIECE_BYTES):
                pass
    except (EOFError, zlib.error) as error:
        raise FileError(f"{path}: expected a whole gzip file: {one_line(error)}") from error
