"""Messages of OpenIGTLink [1]_, whose contents pyigtl packs and unpacks.

Positions are in mm. The world is the one of the sender's TRANSFORMs (PLUS: the frame after ``To`` in a name
as ``ImageToReference``; Slicer: RAS). An image whose message says LPS is turned into RAS, as Slicer does.

References
----------
.. [1] J. Tokuda et al., "OpenIGTLink: an open network protocol for image-guided therapy environment", Int. J.
   Med. Robot. Comput. Assist. Surg., 2009; versions 1 to 3 at openigtlink.org/protocols.
"""

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyigtl.messages
from fastcrc.crc64 import ecma_182
from pyigtl import ImageMessage, StringMessage, TransformMessage
from pyigtl.messages import MessageBase

from speckle3d.core.arrays import AnyArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.io.images.headers import RAS_FROM_LPS

HEADER = struct.Struct("> H 12s 20s II Q Q")
_STATUS = struct.Struct("> H q 20s")
_TYPE = re.compile(rb"[A-Z][A-Z0-9_]*\0*")
_MOST_BYTES = 2**28
"""A colour volume of 400 voxels along each axis; more is a header that is none."""


pyigtl.messages.CRC64 = ecma_182
"""In place of pyigtl's own check sum, the same number in Python, which takes 3 ms of a frame of 1 MB."""


class MessageError(InvalidInputError):
    """A message cannot be what it says it is; one line says why."""


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
    """

    device: str
    time_s: float
    pixels: AnyArray
    image_to_world: FloatArray

    @property
    def spacing_mm(self) -> FloatArray:
        """Distance between columns, rows and slices, shape (3,)."""
        return np.asarray(np.linalg.norm(self.image_to_world[:3, :3], axis=0))


@dataclass(frozen=True)
class TransformReceived:
    """A TRANSFORM: shape (4, 4), mm; invalid where its sender says that the tool was not seen."""

    device: str
    time_s: float
    matrix: FloatArray
    valid: bool


Received = ImageReceived | TransformReceived


def body_bytes(start: bytes) -> int:
    """Length of a message's body, from its first 58 bytes.

    Raises
    ------
    MessageError
        If they begin none, after which nothing in the stream can be trusted.
    """
    version, kind, _, _, _, size, _ = HEADER.unpack(start)
    if version not in (1, 2, 3) or not _TYPE.fullmatch(kind) or size > _MOST_BYTES:
        raise MessageError(
            f"expected the header of a message, got version {version}, type {_text(kind)!r} and {size} bytes"
        )
    return int(size)


def decode(start: bytes, body: bytes) -> Received | None:
    """Decode a message from its first 58 bytes and its body; None of a type that is not used here.

    A check sum of 0 is not checked.

    Raises
    ------
    MessageError
        If its check sum is wrong, or its content is not what its type says.
    """
    version, kind, name, seconds, fraction, _, crc = HEADER.unpack(start)
    type_, device, time_s = _text(kind), _text(name), seconds + fraction / 2**32
    where = f"{type_} {device}"
    if crc and ecma_182(body) != crc:
        raise MessageError(f"{where}: expected a body of check sum {crc:016x}, got another")
    if type_ not in _READ:
        return None
    fields = {"message_type": type_, "device_name": device, "timestamp": time_s, "header_version": version}
    try:
        with np.errstate(all="ignore"):  # of infinite matrices
            message = MessageBase.create_message(type_)
            message.unpack(fields, body)
            return _READ[type_](message)
    # pyigtl trusts a body: what makes no sense shows in whatever it stumbles over.
    except Exception as error:
        words = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise MessageError(f"{where}: cannot be unpacked: {words}") from error


def packed_image(
    device: str, time_s: float, pixels: AnyArray, image_to_world: FloatArray, components: int = 1
) -> bytes:
    """Pack an IMAGE in RAS, the world of Slicer and of TRANSFORMs.

    Parameters
    ----------
    device : str
        At most 20 letters of ASCII; PLUS's are as ``Image_Reference``.
    pixels : ndarray, shape (column, row) or (column, row, slice), with an axis more if of several components
    image_to_world : ndarray, shape (4, 4)
        From column, row and slice to mm.

    Raises
    ------
    InvalidInputError
        If the image is of a type or a size that OpenIGTLink does not know.
    """
    whole = pixels if pixels.ndim - (components > 1) == 3 else np.expand_dims(pixels, 2)
    by_slice = whole.transpose(2, 1, 0, *range(3, whole.ndim))
    native = np.ascontiguousarray(by_slice, pixels.dtype.newbyteorder("="))
    return _pack(ImageMessage(native, image_to_world, "ras"), device, time_s)


def packed_transform(device: str, time_s: float, matrix: FloatArray) -> bytes:
    """Pack a TRANSFORM, shape (4, 4), mm."""
    return _pack(TransformMessage(matrix), device, time_s)


def packed_text(device: str, time_s: float, text: str) -> bytes:
    """Pack a STRING."""
    message = StringMessage(text.encode("ascii", "backslashreplace").decode("ascii"))
    return _pack(message, device, time_s)


def packed_status(device: str, time_s: float, text: str, code: int) -> bytes:
    """Pack a STATUS, which pyigtl does not know; `code` 1 says that all is well."""
    message: Any = MessageBase()
    body = _STATUS.pack(code, 0, b"OK" if code == 1 else b"") + text.encode("ascii", "backslashreplace")
    message._message_type, message._pack_content = "STATUS", lambda: body + b"\0"
    return _pack(message, device, time_s)


def _pack(message: Any, device: str, time_s: float) -> bytes:
    message.header_version, message.device_name, message.timestamp = 1, device, time_s
    try:
        return bytes(message.pack())
    except (struct.error, IndexError) as error:  # of an image too long, or of a type that it does not know
        where = f"{message.message_type} {device}"
        raise InvalidInputError(f"{where}: expected what OpenIGTLink can hold: {error}") from error


def _image(message: Any) -> ImageReceived:
    matrix = message.ijk_to_world_matrix
    if message.world_coordinate_system == "lps":
        matrix = RAS_FROM_LPS @ matrix
    by_slice: AnyArray = message.image
    pixels = by_slice.transpose(2, 1, 0, *range(3, by_slice.ndim))
    if pixels.shape[2] == 1:
        pixels = pixels[:, :, 0]
    pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    return ImageReceived(message.device_name, message.timestamp, pixels, matrix)


def _transform(message: Any) -> TransformReceived:
    fields = message.metadata
    says_ok = fields.get("TransformValid", "True") != "False" and fields.get("TransformStatus", "OK") == "OK"
    valid = says_ok and bool(np.isfinite(message.matrix).all())
    return TransformReceived(message.device_name, message.timestamp, message.matrix, valid)


_READ: dict[str, Callable[[Any], Received]] = {"IMAGE": _image, "TRANSFORM": _transform}


def _text(raw: bytes) -> str:
    return raw.split(b"\0")[0].decode("ascii", "replace").strip()
