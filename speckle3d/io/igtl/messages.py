"""Messages of OpenIGTLink [1]_, of which pyigtl packs and unpacks the contents; here they are checked.

Positions are in mm. The world is the one of the sender's TRANSFORMs (PLUS: the frame after ``To`` in a name
as ``ImageToReference``; Slicer: RAS). An image whose message says LPS is turned into RAS, as Slicer does.

References
----------
.. [1] J. Tokuda et al., "OpenIGTLink: an open network protocol for image-guided therapy environment", Int. J.
   Med. Robot. Comput. Assist. Surg., 2009; versions 1 to 3 at openigtlink.org/protocols.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from fastcrc.crc64 import ecma_182
from pyigtl import ImageMessage, StringMessage, TransformMessage
from pyigtl.messages import MessageBase

from speckle3d.core.arrays import FloatArray
from speckle3d.io.igtl.header import (
    EXTENDED,
    STATUS,
    Header,
    damaged,
    named,
    read_header,
    require_image_size,
    require_parts,
    text,
)
from speckle3d.io.igtl.header import Limits as Limits
from speckle3d.io.igtl.header import MessageError as MessageError
from speckle3d.io.igtl.packing import packed_image as packed_image
from speckle3d.io.igtl.packing import packed_status as packed_status
from speckle3d.io.igtl.packing import packed_text as packed_text
from speckle3d.io.igtl.packing import packed_transform as packed_transform

_RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])

_UNPACK_FAILURES = (
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    OverflowError,
    NotImplementedError,
    struct.error,
)
"""What pyigtl raises, by place, on contents that make no sense."""


@dataclass(frozen=True)
class ImageReceived:
    """An IMAGE.

    Attributes
    ----------
    device : str
    time_s : float
        The sender's clock.
    pixels : ndarray, shape (column, row) or (column, row, slice), with an axis more if of several components
        In the message's order, whose columns run fastest: the transposed of one slice is contiguous.
    image_to_world : ndarray, shape (4, 4)
        From column, row and slice of a pixel's centre to mm; the size of pixels is in it.
    spacing_mm : ndarray, shape (3,)
        Distance between columns, rows and slices.
    components : int
        Numbers a pixel has: 3 of a colour image.
    """

    device: str
    time_s: float
    pixels: npt.NDArray[Any]
    image_to_world: FloatArray
    spacing_mm: FloatArray
    components: int = 1


@dataclass(frozen=True)
class TransformReceived:
    """A TRANSFORM: shape (4, 4), mm; invalid where its sender says that the tool was not seen."""

    device: str
    time_s: float
    matrix: FloatArray
    valid: bool


@dataclass(frozen=True)
class TextReceived:
    """A STRING."""

    device: str
    time_s: float
    text: str


@dataclass(frozen=True)
class StatusReceived:
    """A STATUS; `code` 1 says that all is well."""

    device: str
    time_s: float
    code: int
    text: str


@dataclass(frozen=True)
class Other:
    """A message that nothing here has a use for."""

    device: str
    time_s: float
    type: str


Received: TypeAlias = ImageReceived | TransformReceived | TextReceived | StatusReceived | Other


def decode(header: bytes | bytearray | memoryview, body: bytes, limits: Limits | None = None) -> Received:
    """Make a message of its header and its body.

    Raises
    ------
    MessageError
        If its check sum is wrong, or its content is not what its type says.
    """
    read = read_header(header, limits or Limits())
    if len(body) != read.body_bytes:
        raise MessageError(f"{named(read)}: expected a body of {read.body_bytes} bytes, got {len(body)}")
    if ecma_182(body) != read.crc:
        raise damaged(read)
    return decoded(read, body)


def decoded(header: Header, body: bytes) -> Received:
    """Make a message of a body whose length and check sum are right."""
    make = _MAKERS.get(header.type)
    if make is None:
        return Other(header.device, header.time_s, header.type)
    try:
        require_parts(header, body)
        if header.type == "IMAGE":
            require_image_size(header, body)
        with np.errstate(all="ignore"):  # infinite matrices are refused once they are unpacked
            return make(header, body)
    except MessageError:
        raise
    except _UNPACK_FAILURES as error:
        words = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise MessageError(f"{named(header)}: cannot be unpacked: {words}") from error


def _unpacked(message: MessageBase, header: Header, body: bytes) -> Any:
    fields = {"message_type": header.type, "device_name": header.device, "timestamp": header.time_s}
    message.unpack(fields | {"header_version": header.version}, body)
    return message


def _image(header: Header, body: bytes) -> ImageReceived:
    message = _unpacked(ImageMessage(), header, body)
    matrix = np.asarray(message.ijk_to_world_matrix, dtype=np.float64)
    _require_finite(matrix, header)
    if message.world_coordinate_system == "lps":
        matrix = _RAS_FROM_LPS @ matrix
    by_slice: npt.NDArray[Any] = message.image
    pixels = by_slice.transpose(2, 1, 0, *range(3, by_slice.ndim))
    if pixels.shape[2] == 1:
        pixels = pixels[:, :, 0]
    pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    components = by_slice.shape[3] if by_slice.ndim == 4 else 1
    spacing = np.linalg.norm(matrix[:3, :3], axis=0)
    return ImageReceived(header.device, header.time_s, pixels, matrix, spacing, components)


def _transform(header: Header, body: bytes) -> TransformReceived:
    message = _unpacked(TransformMessage(), header, body)
    matrix = np.asarray(message.matrix, dtype=np.float64)
    _require_finite(matrix, header)
    told = message.metadata
    valid = told.get("TransformValid", "True") != "False" and told.get("TransformStatus", "OK") == "OK"
    return TransformReceived(header.device, header.time_s, matrix, valid)


def _string(header: Header, body: bytes) -> TextReceived:
    return TextReceived(header.device, header.time_s, _unpacked(StringMessage(), header, body).string)


def _status(header: Header, body: bytes) -> StatusReceived:
    first, last = 0, len(body)
    if header.version > 1:
        first, fields, texts, _ = EXTENDED.unpack_from(body)
        last -= fields + texts
    code, _, _ = STATUS.unpack_from(body[:last], first)
    return StatusReceived(header.device, header.time_s, code, text(body[first + STATUS.size : last]))


_MAKERS: dict[str, Callable[[Header, bytes], Received]] = {
    "IMAGE": _image,
    "TRANSFORM": _transform,
    "STRING": _string,
    "STATUS": _status,
}


def _require_finite(matrix: FloatArray, header: Header) -> None:
    if not np.isfinite(matrix).all():
        raise MessageError(f"{named(header)}: expected a finite matrix, got NaN or infinity")
