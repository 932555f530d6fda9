"""Messages of OpenIGTLink made by pyigtl, which knows nothing of our packing."""

import struct
from types import SimpleNamespace

import numpy as np
import pyigtl
from pyigtl.messages import CRC64

from speckle3d.io.igtl.messages import HEADER, body_bytes, decode


def image(columns=6, rows=9, dtype=np.int16, version=1, **fields):
    """An IMAGE of pyigtl, the pixels (column, row) in it, and where they lie."""
    pixels = np.random.default_rng(0).integers(0, 200, (columns, rows)).astype(dtype)
    place = np.array([[0.0, 0, 2, 1], [0.3, 0, 0, 2], [0, 0.1, 0, 3], [0, 0, 0, 1]])
    message = pyigtl.ImageMessage(pixels.T[None], place, fields.pop("world", "ras"), 12.25, "Image_Reference")
    message.header_version, message.metadata = version, fields
    return message.pack(), pixels, place


def transform(device="ProbeToTracker", version=1, **fields):
    """A TRANSFORM of pyigtl and its matrix."""
    matrix = np.eye(4)
    matrix[:3] += np.random.default_rng(1).normal(0, 1, (3, 4))
    message = pyigtl.TransformMessage(matrix, 12.5, device)
    message.header_version, message.metadata = version, fields
    return message.pack(), matrix


LAST = transform("Last")[0]


def with_body(message, body):
    """The message with another body and the right length and check sum."""
    fields = list(HEADER.unpack(message[: HEADER.size]))
    fields[5:] = len(body), CRC64(body)
    return HEADER.pack(*fields) + body


def decode_whole(message):
    """A packed message as we read it; of others their device, and their type with what it says."""
    start, body = message[: HEADER.size], message[HEADER.size :]
    body_bytes(start)
    content = decode(start, body)
    if content is not None:
        return content
    kind, device = (raw.rstrip(b"\0").decode() for raw in HEADER.unpack(start)[1:3])
    return SimpleNamespace(device=device, type=f"{kind} {body[4:].decode(errors='replace')}")


def with_values(at, form, *values):
    """An image with other bytes in its body, and their check sum."""
    message = image()[0]
    body = bytearray(message[HEADER.size :])
    struct.pack_into(form, body, at, *values)
    return with_body(message, bytes(body))
