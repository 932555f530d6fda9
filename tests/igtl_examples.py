"""Messages of OpenIGTLink made by pyigtl, which knows nothing of our packing."""

import struct
from dataclasses import replace

import numpy as np
import pyigtl
from pyigtl.messages import CRC64

from speckle3d.io.igtl.messages import HEADER, body_bytes, decode


def image(columns=6, rows=9, dtype=np.int16, device="Image_Reference", seed=0, version=1, **said):
    """An IMAGE of pyigtl, the pixels (column, row) in it, and where they lie."""
    pixels = np.random.default_rng(seed).integers(0, 200, (columns, rows)).astype(dtype)
    place = np.array([[0.0, 0, 2, 1], [0.3, 0, 0, 2], [0, 0.1, 0, 3], [0, 0, 0, 1]])
    message = pyigtl.ImageMessage(pixels.T[None], place, said.pop("world", "ras"), 12.25, device)
    message.header_version, message.metadata = version, said
    return message.pack(), pixels, place


def transform(device="ProbeToTracker", seed=1, version=1, time_s=12.5, **said):
    """A TRANSFORM of pyigtl and its matrix."""
    matrix = np.eye(4)
    matrix[:3] += np.random.default_rng(seed).normal(0, 1, (3, 4))
    message = pyigtl.TransformMessage(matrix, time_s, device)
    message.header_version, message.metadata = version, said
    return message.pack(), matrix


LAST = transform("Last")[0]


def with_body(message, body, crc=None):
    """The message with another body and the right length and check sum, or another."""
    fields = list(HEADER.unpack(message[: HEADER.size]))
    fields[5:] = len(body), CRC64(body) if crc is None else crc
    return HEADER.pack(*fields) + body


def decoded(message):
    """A packed message as we read it; of a STRING, the words behind its type."""
    start, body = message[: HEADER.size], message[HEADER.size :]
    body_bytes(start)
    got = decode(start, body)
    is_text = getattr(got, "type", "") == "STRING"
    return replace(got, type=f"STRING {body[4:].decode()}") if is_text else got


def changed(at, form, *values):
    """An image with other bytes in its body, and their check sum."""
    message = image()[0]
    body = bytearray(message[HEADER.size :])
    struct.pack_into(form, body, at, *values)
    return with_body(message, bytes(body))
