"""Messages of OpenIGTLink to be sent, of which pyigtl packs the contents."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import numpy.typing as npt
from fastcrc.crc64 import ecma_182
from pyigtl import ImageMessage, StringMessage, TransformMessage
from pyigtl.messages import MessageBase

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.io.igtl.header import EXTENDED, HEADER, STATUS

STATUS_OK = 1


def packed_image(
    device: str, time_s: float, pixels: npt.NDArray[Any], image_to_world: FloatArray, components: int = 1
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
    with_slices = pixels.ndim == 3 + (components > 1)
    if pixels.ndim != 2 + with_slices + (components > 1) or not all(0 < n < 2**16 for n in pixels.shape[:3]):
        raise InvalidInputError(
            f"image: expected shape (column, row[, slice]) of 1 to 65535 each, got {pixels.shape}"
        )
    if pixels.dtype.newbyteorder("=") not in ImageMessage.scalar_types.values():
        raise InvalidInputError(f"image: expected integers of 1 to 4 bytes or floats, got {pixels.dtype}")
    whole = pixels if with_slices else np.expand_dims(pixels, 2)
    native = pixels.dtype.newbyteorder("=")
    turned = np.ascontiguousarray(whole.transpose(2, 1, 0, *range(3, whole.ndim)), native)
    return _packed(ImageMessage(turned, image_to_world, "ras"), device, time_s)


def packed_transform(device: str, time_s: float, matrix: FloatArray, valid: bool = True) -> bytes:
    """Pack a TRANSFORM, shape (4, 4), mm; one that is not valid says so as PLUS's do."""
    message = TransformMessage(matrix)
    if not valid:
        message.header_version = 2
        message.metadata = {"TransformValid": "False", "TransformStatus": "MISSING"}
    return _packed(message, device, time_s)


def packed_text(device: str, time_s: float, text: str) -> bytes:
    """Pack a STRING."""
    message = StringMessage(text.encode("ascii", "backslashreplace").decode("ascii"))
    return _packed(message, device, time_s)


def packed_status(device: str, time_s: float, text: str, code: int = STATUS_OK) -> bytes:
    """Pack a STATUS; `code` 1 says that all is well."""
    name = b"OK" if code == STATUS_OK else b""
    body = STATUS.pack(code, 0, name) + text.encode("ascii", "backslashreplace") + b"\0"
    return _with_header("STATUS", device, time_s, body)


def _packed(message: MessageBase, device: str, time_s: float) -> bytes:
    """Header and body; pyigtl's own check sum takes 3 ms of a frame of 1 MB."""
    content = message._pack_content()
    if message.header_version == 1:
        return _with_header(message.message_type, device, time_s, content)
    fields = [(key.encode(), value.encode("ascii")) for key, value in message.metadata.items()]
    heads = b"".join(
        struct.pack("> HHI", len(key), MessageBase.IANA_CHARACTER_SET_ASCII, len(value))
        for key, value in fields
    )
    heads, texts = struct.pack("> H", len(fields)) + heads, b"".join(key + value for key, value in fields)
    extended = EXTENDED.pack(EXTENDED.size, len(heads), len(texts), 0)
    body = b"".join((extended, content, heads, texts))
    return _with_header(message.message_type, device, time_s, body, message.header_version)


def _with_header(kind: str, device: str, time_s: float, body: bytes, version: int = 1) -> bytes:
    named = device.encode("ascii", "replace")
    if len(named) > 20:
        raise InvalidInputError(f"device {device!r}: expected a name of at most 20 letters, got {len(named)}")
    if not 0 <= time_s < 2**32:
        raise InvalidInputError(f"device {device!r}: expected a time from 0 to 2^32 s, got {time_s}")
    seconds = int(time_s)
    fraction = min(round((time_s - seconds) * 2**32), 2**32 - 1)
    crc = ecma_182(body)
    return HEADER.pack(version, kind.encode(), named, seconds, fraction, len(body), crc) + body
