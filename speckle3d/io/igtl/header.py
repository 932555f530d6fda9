"""Headers of OpenIGTLink's messages, and what they may say."""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass
from typing import Final

from speckle3d.core.errors import InvalidInputError

HEADER_BYTES: Final = 58
HEADER = struct.Struct("> H 12s 20s II Q Q")
EXTENDED = struct.Struct("> H H I I")
IMAGE = struct.Struct("> H B B B B 3H 12f 3H 3H")
STATUS = struct.Struct("> H q 20s")

_VERSIONS = (1, 2, 3)
_NAME = re.compile(rb"[A-Z][A-Z0-9_]*\0*")
_SCALAR_BYTES = {2: 1, 3: 1, 4: 2, 5: 2, 6: 4, 7: 4, 10: 4, 11: 8}
_RAS, _LPS = 1, 2
_QUERIES = ("GET_", "STT_", "STP_", "RTS_")
"""How types of messages begin that may have no body."""


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


def read_header(header: bytes | bytearray | memoryview, limits: Limits) -> Header:
    """Read the first 58 bytes of a message.

    Raises
    ------
    MessageError
        If they are none, or the message is longer than the limits allow.
    """
    if len(header) != HEADER_BYTES:
        raise MessageError(f"expected a header of {HEADER_BYTES} bytes, got {len(header)}")
    version, kind, device, seconds, fraction, size, crc = HEADER.unpack(header)
    if version not in _VERSIONS or not _NAME.fullmatch(kind):
        raise MessageError(f"expected the header of a message, got version {version} and type {text(kind)!r}")
    found = Header(version, text(kind), text(device), seconds + fraction / 2**32, size, crc)
    most = limits.max_body_bytes if found.type == "IMAGE" else limits.max_other_body_bytes
    if not size and not found.type.startswith(_QUERIES):
        # Zeros are the right check sum of no bytes, and so say nothing.
        raise MessageError(f"{named(found)}: expected a body, got none")
    if size > most:
        raise MessageError(f"{named(found)}: expected at most {most} bytes, got {size}")
    return found


def require_image_size(header: Header, start: bytes | bytearray | memoryview) -> None:
    """Raise `MessageError` if the start of an image's body says that it is of another length.

    So a wrong length is found before the peer's next messages were taken for pixels.
    """
    first, beside = 0, 0
    if len(start) < image_start_bytes(header):
        raise MessageError(f"{named(header)}: expected an image, got {header.body_bytes} bytes")
    if header.version > 1:
        first, fields, texts, _ = EXTENDED.unpack_from(start)
        _require_extended(header, first)
        beside = first + fields + texts
    _, components, scalar, endian, world, *numbers = IMAGE.unpack_from(start, first)
    size, part = numbers[:3], numbers[15:]
    if scalar not in _SCALAR_BYTES or endian not in (1, 2) or world not in (_RAS, _LPS) or not components:
        raise MessageError(
            f"{named(header)}: expected scalars of a known type, order and world, got type {scalar}, order "
            f"{endian}, world {world}, {components} components"
        )
    if 0 in size or part != [0, 0, 0, *size]:
        raise MessageError(f"{named(header)}: expected a whole image, got {part} of {size}")
    expected = beside + IMAGE.size + components * _SCALAR_BYTES[scalar] * math.prod(size)
    if expected != header.body_bytes:
        raise MessageError(
            f"{named(header)}: expected {expected} bytes for an image of {size}, got {header.body_bytes}"
        )


def image_start_bytes(header: Header) -> int:
    """Bytes of an image's body that `require_image_size` looks at."""
    return IMAGE.size + (EXTENDED.size if header.version > 1 else 0)


def damaged(header: Header) -> MessageError:
    """Error of a body whose check sum is wrong."""
    return MessageError(f"{named(header)}: expected a body of check sum {header.crc:016x}, got another")


def require_parts(header: Header, body: bytes) -> None:
    """Refuse a body whose extended header and metadata, from version 2 on, are longer than it."""
    if header.version == 1:
        return
    first, fields, texts, _ = EXTENDED.unpack_from(body)
    _require_extended(header, first)
    if first + fields + texts > len(body):
        raise MessageError(
            f"{named(header)}: expected metadata within {len(body)} bytes, got {fields} and {texts}"
        )


def _require_extended(header: Header, size: int) -> None:
    if size != EXTENDED.size:
        raise MessageError(
            f"{named(header)}: expected an extended header of {EXTENDED.size} bytes, got {size}"
        )


def text(raw: bytes) -> str:
    """Text up to its end or the first zero."""
    return raw.split(b"\0")[0].decode("utf-8", "replace").rstrip()


def named(header: Header) -> str:
    """How an error names a message."""
    return f"{header.type} of {header.device!r}"
