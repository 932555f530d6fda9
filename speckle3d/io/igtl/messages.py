"""Messages of OpenIGTLink [1]_, of which pyigtl packs and unpacks the contents; here they are checked.

Positions are in mm. The world is the one of the sender's TRANSFORMs (PLUS: the frame after ``To`` in a name
as ``ImageToReference``; Slicer: RAS). An image whose message says LPS is turned into RAS, as Slicer does.

References
----------
.. [1] J. Tokuda et al., "OpenIGTLink: an open network protocol for image-guided therapy environment", Int. J.
   Med. Robot. Comput. Assist. Surg., 2009; versions 1 to 3 at openigtlink.org/protocols.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt
from fastcrc.crc64 import ecma_182
from pyigtl import ImageMessage, StringMessage, TransformMessage
from pyigtl.messages import MessageBase

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError

HEADER_BYTES: Final = 58
_HEADER = struct.Struct("> H 12s 20s II Q Q")
_EXTENDED = struct.Struct("> H H I I")
_IMAGE = struct.Struct("> H B B B B 3H 12f 3H 3H")
_STATUS = struct.Struct("> H q 20s")

_VERSIONS = (1, 2, 3)
_NAME = re.compile(rb"[A-Z][A-Z0-9_]*\0*")
_SCALAR_BYTES = {2: 1, 3: 1, 4: 2, 5: 2, 6: 4, 7: 4, 10: 4, 11: 8}
_RAS, _LPS = 1, 2
_STATUS_OK = 1
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


class MessageError(InvalidInputError):
    """A message cannot be what it says it is; one line says why."""


@dataclass(frozen=True)
class Limits:
    """What a peer may make this side keep.

    Attributes
    ----------
    max_body_bytes : int
        Of an IMAGE.
    max_other_body_bytes : int
        Of any other message: transforms, texts and states are small.
    max_waiting_bytes : int
        Of messages received and not yet taken; then the peer has to wait.
    max_sending_bytes : int
        Of messages not yet sent; then the oldest are dropped.
    stall_s : float
        Longest pause within a message.
    """

    max_body_bytes: int = 64 * 2**20
    max_other_body_bytes: int = 2**18
    max_waiting_bytes: int = 256 * 2**20
    max_sending_bytes: int = 64 * 2**20
    stall_s: float = 10.0


@dataclass(frozen=True)
class Header:
    """The first 58 bytes of a message.

    Attributes
    ----------
    type : str
        As IMAGE or TRANSFORM.
    device : str
        Name of what sent it, as PLUS's ``ProbeToTracker``.
    time_s : float
        The sender's clock.
    """

    version: int
    type: str
    device: str
    time_s: float
    body_bytes: int
    crc: int


@dataclass(frozen=True)
class ImageReceived:
    """An IMAGE.

    Attributes
    ----------
    device : str
    time_s : float
        The sender's clock.
    pixels : ndarray, shape (column, row) or (column, row, slice), with an axis more if of several components
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


def read_header(header: bytes | bytearray | memoryview, limits: Limits) -> Header:
    """Read the first 58 bytes of a message.

    Raises
    ------
    MessageError
        If they are none, or the message is longer than the limits allow.
    """
    version, kind, device, seconds, fraction, size, crc = _HEADER.unpack(header)
    if version not in _VERSIONS or not _NAME.fullmatch(kind):
        raise MessageError(
            f"expected the header of a message, got version {version} and type {_text(kind)!r}"
        )
    found = Header(version, _text(kind), _text(device), seconds + fraction / 2**32, size, crc)
    most = limits.max_body_bytes if found.type == "IMAGE" else limits.max_other_body_bytes
    if size > most:
        raise MessageError(f"{_named(found)}: expected at most {most} bytes, got {size}")
    return found


def require_image_size(header: Header, start: bytes | bytearray | memoryview) -> None:
    """Raise `MessageError` if the start of an image's body says that it is of another length.

    So a wrong length is found before the peer's next messages were taken for pixels.
    """
    first, beside = 0, 0
    if len(start) < image_start_bytes(header):
        raise MessageError(f"{_named(header)}: expected an image, got {header.body_bytes} bytes")
    if header.version > 1:
        first, fields, texts, _ = _EXTENDED.unpack_from(start)
        _require_extended(header, first)
        beside = first + fields + texts
    _, components, scalar, endian, world, *numbers = _IMAGE.unpack_from(start, first)
    size, part = numbers[:3], numbers[15:]
    if scalar not in _SCALAR_BYTES or endian not in (1, 2) or world not in (_RAS, _LPS) or not components:
        raise MessageError(
            f"{_named(header)}: expected scalars of a known type, order and world, got type {scalar}, order "
            f"{endian}, world {world}, {components} components"
        )
    if 0 in size or part != [0, 0, 0, *size]:
        raise MessageError(f"{_named(header)}: expected a whole image, got {part} of {size}")
    expected = beside + _IMAGE.size + components * _SCALAR_BYTES[scalar] * math.prod(size)
    if expected != header.body_bytes:
        raise MessageError(
            f"{_named(header)}: expected {expected} bytes for an image of {size}, got {header.body_bytes}"
        )


def image_start_bytes(header: Header) -> int:
    """Bytes of an image's body that `require_image_size` looks at."""
    return _IMAGE.size + (_EXTENDED.size if header.version > 1 else 0)


def decode(header: bytes | bytearray | memoryview, body: bytes, limits: Limits | None = None) -> Received:
    """Make a message of its header and its body.

    Raises
    ------
    MessageError
        If its check sum is wrong, or its content is not what its type says.
    """
    read = read_header(header, limits or Limits())
    if len(body) != read.body_bytes:
        raise MessageError(f"{_named(read)}: expected a body of {read.body_bytes} bytes, got {len(body)}")
    if ecma_182(body) != read.crc:
        raise damaged(read)
    return decoded(read, body)


def damaged(header: Header) -> MessageError:
    """Error of a body whose check sum is wrong."""
    return MessageError(f"{_named(header)}: expected a body of check sum {header.crc:016x}, got another")


def decoded(header: Header, body: bytes) -> Received:
    """Make a message of a body whose length and check sum are right."""
    make = _MAKERS.get(header.type)
    if make is None:
        return Other(header.device, header.time_s, header.type)
    try:
        _require_parts(header, body)
        if header.type == "IMAGE":
            require_image_size(header, body)
        return make(header, body)
    except MessageError:
        raise
    except _UNPACK_FAILURES as error:
        words = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise MessageError(f"{_named(header)}: cannot be unpacked: {words}") from error


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
    turned = np.ascontiguousarray(whole.transpose(2, 1, 0, *range(3, whole.ndim)))
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


def packed_status(device: str, time_s: float, text: str, code: int = _STATUS_OK) -> bytes:
    """Pack a STATUS; `code` 1 says that all is well."""
    name = b"OK" if code == _STATUS_OK else b""
    body = _STATUS.pack(code, 0, name) + text.encode("ascii", "backslashreplace") + b"\0"
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
    extended = _EXTENDED.pack(_EXTENDED.size, len(heads), len(texts), 0)
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
    return _HEADER.pack(version, kind.encode(), named, seconds, fraction, len(body), crc) + body


def _require_parts(header: Header, body: bytes) -> None:
    """Refuse a body whose extended header and metadata, from version 2 on, are longer than it."""
    if header.version == 1:
        return
    first, fields, texts, _ = _EXTENDED.unpack_from(body)
    _require_extended(header, first)
    if first + fields + texts > len(body):
        raise MessageError(
            f"{_named(header)}: expected metadata within {len(body)} bytes, got {fields} and {texts}"
        )


def _require_extended(header: Header, size: int) -> None:
    if size != _EXTENDED.size:
        raise MessageError(
            f"{_named(header)}: expected an extended header of {_EXTENDED.size} bytes, got {size}"
        )


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
    pixels = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("="))
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
        first, fields, texts, _ = _EXTENDED.unpack_from(body)
        last -= fields + texts
    code, _, _ = _STATUS.unpack_from(body[:last], first)
    return StatusReceived(header.device, header.time_s, code, _text(body[first + _STATUS.size : last]))


_MAKERS: dict[str, Callable[[Header, bytes], Received]] = {
    "IMAGE": _image,
    "TRANSFORM": _transform,
    "STRING": _string,
    "STATUS": _status,
}


def _require_finite(matrix: FloatArray, header: Header) -> None:
    if not np.isfinite(matrix).all():
        raise MessageError(f"{_named(header)}: expected a finite matrix, got NaN or infinity")


def _text(raw: bytes) -> str:
    return raw.split(b"\0")[0].decode("utf-8", "replace").rstrip()


def _named(header: Header) -> str:
    return f"{header.type} of {header.device!r}"
