"""NIfTI-1 files: header, fields in an extension, and reading them; their world is right, anterior, superior.

Numbers in a NIfTI header are of single precision: places are kept to some 1e-7 of their distance from the
origin. Both the matrix (sform) and the quaternion (qform) are written, with the code of a scanner's
coordinates. The matrix counts where readers differ: near a half turn the quaternion's first number, which
is not stored, comes back to 3e-4 only.

References
----------
.. [1] R. W. Cox et al., "A (sort of) new image data format standard: NIfTI-1", NeuroImage, 2004; nifti1.h.
"""

from __future__ import annotations

import gzip
import json
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import open_regular
from speckle3d.core.printable import printable
from speckle3d.io.hdf5 import one_line, reading
from speckle3d.io.pixels import Pixels, read_pixels
from speckle3d.io.voxels.volume_headers import VolumeHeader

GZIP_SIGNATURE = b"\x1f\x8b"
_HEADER_BYTES = 348
_FIRST_EXTENSION = 352
_MAGIC = b"n+1\0"
_TYPES = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4"}
_MM = 2
_SCANNER = 1
_LABELS = 1002
"""Code of an image of labels (NIFTI_INTENT_LABEL)."""
_COMMENT = 6
"""Code of an extension of text (NIFTI_ECODE_COMMENT)."""
_LONGEST = 2**15 - 1
_TO_RAS = np.array([-1.0, -1.0, 1.0])
_OWN = "speckle3d"


@dataclass(frozen=True)
class NiftiImage:
    """What a NIfTI file holds.

    Attributes
    ----------
    size : tuple of int
    voxels : ndarray, shape (count,)
    steps_mm : ndarray, shape (3, 3)
        From a voxel to the next along each axis, a row each, in a world of left, posterior, superior.
    origin_mm : ndarray, shape (3,)
    is_labels : bool
    fields : dict of str to str
        Of this package's own comment.
    """

    size: tuple[int, ...]
    voxels: npt.NDArray[Any]
    steps_mm: FloatArray
    origin_mm: FloatArray
    is_labels: bool
    fields: dict[str, str]


def is_nifti(start: bytes) -> bool:
    """Whether a file's first bytes are those of NIfTI-1 that is not packed: the length of its header."""
    return start[:4] in (struct.pack("<i", _HEADER_BYTES), struct.pack(">i", _HEADER_BYTES))


def nifti_header(header: VolumeHeader, is_labels: bool) -> bytes:
    """Header of a NIfTI-1 file up to its voxels, fields included.

    Raises
    ------
    InvalidInputError
        If an axis is longer than the 32,767 voxels that the format counts.
    """
    if max(header.shape) > _LONGEST:
        raise InvalidInputError(
            f"NIfTI: expected at most {_LONGEST} voxels along an axis, got {max(header.shape)}: take .nrrd"
        )
    extension = _extension({**header.fields, **header.plain})
    code = next(code for code, name in _TYPES.items() if np.dtype(name) == header.dtype)
    spacing = np.asarray(header.spacing_mm)
    turned = header.axes.T * _TO_RAS[:, None]
    matrix = np.column_stack((turned * spacing, header.origin_mm * _TO_RAS))
    head = bytearray(_HEADER_BYTES)
    put = struct.pack_into
    put("<i", head, 0, _HEADER_BYTES)
    put("<8h", head, 40, 3, *header.shape, 1, 1, 1, 1)
    put("<3h", head, 68, _LABELS if is_labels else 0, code, 8 * header.dtype.itemsize)
    put("<8f", head, 76, 1.0, *spacing, 0, 0, 0, 0)
    put("<3f", head, 108, _FIRST_EXTENSION + len(extension), 1.0, 0.0)
    head[123] = _MM
    head[148:228] = _described(header.fields).ljust(80, b"\0")
    put("<2h", head, 252, _SCANNER, _SCANNER)
    put("<3f", head, 256, *_quaternion(turned))
    put("<3f", head, 268, *matrix[:, 3])
    put("<12f", head, 280, *matrix.ravel())
    head[344:348] = _MAGIC
    return bytes(head) + bytes((1 if extension else 0, 0, 0, 0)) + extension


def read_nifti(path: Path, size_bytes: int, is_packed: bool) -> NiftiImage:
    """Read a NIfTI-1 file, in gzip or not.

    Raises
    ------
    FileError
        If it is truncated or damaged.
    InvalidInputError
        If it is not a grey image of three axes.
    """
    head = _head(path, is_packed)
    if len(head) < _HEADER_BYTES or head[344:347] != _MAGIC[:3]:
        raise FileError(f"{path}: expected NIfTI-1 in one file, got something else, or a truncated one")
    order = "<" if head[:4] == struct.pack("<i", _HEADER_BYTES) else ">"
    dimensions = struct.unpack(f"{order}8h", head[40:56])
    intent, kind = struct.unpack(f"{order}2h", head[68:72])
    pixdim = np.array(struct.unpack(f"{order}8f", head[76:108]))
    start, slope, offset = struct.unpack(f"{order}3f", head[108:120])
    size = tuple(dimensions[1 : 1 + max(dimensions[0], 0)])
    while len(size) > 3 and size[-1] == 1:
        size = size[:-1]
    whole = np.isfinite(start) and start == int(start) and _HEADER_BYTES <= start <= 2**30
    if len(size) != 3 or min(size) < 1 or kind not in _TYPES or not whole:
        got = f"{len(size)} axes {size}, type {kind}, voxels from byte {start:g}"
        raise InvalidInputError(f"{path}: expected a grey NIfTI image of three axes, got {got}")
    dtype = np.dtype(order + _TYPES[kind])
    skipped = int(start)
    count = int(np.prod(size, dtype=np.int64)) * dtype.itemsize + skipped
    if not is_packed and count > size_bytes:
        raise FileError(f"{path}: expected {count} bytes, got {size_bytes}: truncated")
    data = read_pixels(
        Pixels(path, 0, size_bytes, np.dtype(np.uint8), count, "deflate" if is_packed else "raw")
    )
    fields = _held_fields(data[_HEADER_BYTES:skipped].tobytes(), order)
    voxels = np.frombuffer(data.data, dtype, offset=skipped).astype(dtype.newbyteorder("="), copy=False)
    if slope != 0 and (slope, offset) != (1, 0):
        voxels = (voxels * np.float32(slope) + np.float32(offset)).astype(np.float32)
    steps, origin = _pose(head, order, pixdim)
    return NiftiImage(size, voxels, steps * _TO_RAS, origin * _TO_RAS, intent == _LABELS, fields)


def _extension(fields: Mapping[str, str]) -> bytes:
    """Fields as an extension of text, JSON; its length is a multiple of 16 bytes."""
    if not fields:
        return b""
    text = json.dumps({_OWN: dict(fields)}, ensure_ascii=False).encode("utf-8", "backslashreplace")
    size = -(-(8 + len(text)) // 16) * 16
    return struct.pack("<2i", size, _COMMENT) + text.ljust(size - 8, b"\0")


def _held_fields(extensions: bytes, order: str) -> dict[str, str]:
    """Fields in the first extension that is of this package; none where there is no such one."""
    at = 4
    while at + 8 <= len(extensions) and extensions[0]:
        size, code = struct.unpack(f"{order}2i", extensions[at : at + 8])
        if size < 16 or at + size > len(extensions):
            break
        if code == _COMMENT and (found := _own_fields(extensions[at + 8 : at + size])):
            return found
        at += size
    return {}


def _own_fields(text: bytes) -> dict[str, str]:
    try:
        told = json.loads(text.rstrip(b"\0").decode("utf-8"))
    except (ValueError, RecursionError):  # a comment of somebody else
        return {}
    held = told.get(_OWN) if isinstance(told, dict) else None
    return {str(name): str(value) for name, value in held.items()} if isinstance(held, dict) else {}


def _described(fields: Mapping[str, str]) -> bytes:
    """What the 79 bytes of a header's description can say of the fields."""
    text = printable("; ".join((_OWN, *(f"{name}: {value}" for name, value in fields.items()))))
    return text.encode("ascii", "replace")[:79]


def _quaternion(turned: FloatArray) -> FloatArray:
    """Last three numbers of a rotation's quaternion, the first of which is not below zero."""
    return Rotation.from_matrix(turned).as_quat(canonical=True, scalar_first=True)[1:]


def _pose(head: bytes, order: str, pixdim: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Steps, a row each, and origin: by the matrix (sform), else by the quaternion (qform)."""
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


def _head(path: Path, is_packed: bool) -> bytes:
    with reading(path), open_regular(path) as stream:
        if not is_packed:
            return stream.read(_HEADER_BYTES)
        try:
            with gzip.open(stream) as unpacked:
                return unpacked.read(_HEADER_BYTES)
        except (zlib.error, EOFError, gzip.BadGzipFile) as error:
            raise FileError(f"{path}: expected a whole gzip file: {one_line(error)}") from error
