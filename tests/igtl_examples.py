"""Messages of OpenIGTLink, whole and damaged; made by pyigtl, which knows nothing of our packing."""

import itertools
import struct

import numpy as np
import pyigtl
from pyigtl.messages import CRC64

from speckle3d.io.igtl.framing import Framing
from speckle3d.io.igtl.messages import MessageError

HEADER = struct.Struct("> H 12s 20s II Q Q")
SIZE_AT, CRC_AT = 42, 50


def image(columns=6, rows=9, dtype=np.int16, device="Image_Reference", seed=0, version=1, **told):
    """An IMAGE of pyigtl and the pixels (column, row) in it."""
    pixels = np.random.default_rng(seed).integers(0, 200, (columns, rows)).astype(dtype)
    place = np.array([[0.0, 0, 2, 1], [0.3, 0, 0, 2], [0, 0.1, 0, 3], [0, 0, 0, 1]])
    message = pyigtl.ImageMessage(pixels.T[None], place, told.pop("world", "ras"), 12.25, device)
    message.header_version, message.metadata = version, told
    return message.pack(), pixels, place


def transform(device="ProbeToTracker", seed=1, version=1, time_s=12.5, **told):
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3] += rng.normal(0, 1, (3, 4))
    message = pyigtl.TransformMessage(matrix, time_s, device)
    message.header_version, message.metadata = version, told
    return message.pack(), matrix


def status(text="all is well", code=1):
    body = struct.pack("> H q 20s", code, 0, b"OK") + text.encode() + b"\0"
    return HEADER.pack(1, b"STATUS", b"Server", 7, 2**31, len(body), CRC64(body)) + body


def stream(columns=6):
    """Messages of every kind, one after the other."""
    told = {"TransformValid": "False", "TransformStatus": "MISSING"}
    return b"".join(
        (
            transform()[0],
            image(columns, 40)[0],
            pyigtl.StringMessage("words", 3.5, "Text").pack(),
            image(8, 5, np.uint8, version=2, DepthMm="45")[0],
            transform("StylusToTracker", version=2, **told)[0],
            status(),
            pyigtl.PointMessage([[1.0, 2, 3]], names=["a"], device_name="Marks").pack(),
            image(5, 4, np.float32)[0],
        )
    )


LAST = transform("Last")[0]


def messages_of(content):
    """Cut a whole stream into its messages."""
    found = []
    while content:
        (size,) = struct.unpack_from("> Q", content, SIZE_AT)
        found.append(content[: 58 + size])
        content = content[58 + size :]
    return found


def damaged_message(rng, message):
    """Change the header or the body of a message; its check sum is made right in half of the cases."""
    header, body = bytearray(message[:58]), bytearray(message[58:])
    for _ in range(int(rng.integers(1, 4))):
        how = int(rng.integers(0, 6))
        if how == 0:
            sizes = (0, 1, len(body) + 1, 2**16, 2**20, 2**31, 2**40, 2**63, 2**64 - 1)
            struct.pack_into("> Q", header, SIZE_AT, sizes[int(rng.integers(0, len(sizes)))])
        elif how == 1:
            kinds = (b"IMAGE", b"TRANSFORM", b"STATUS", b"STRING", b"TDATA", b"POLYDATA", b"\xff\0A", b"")
            struct.pack_into("12s", header, 2, kinds[int(rng.integers(0, len(kinds)))])
        elif how == 2:
            struct.pack_into("> H", header, 0, int(rng.choice([0, 1, 2, 3, 4, 65535])))
        elif how == 3 and body:
            # The first bytes say how large an image is, and of what.
            at = int(rng.integers(0, min(len(body), 90)))
            body[at] = int(rng.integers(0, 256))
        elif how == 4 and body:
            at = int(rng.integers(0, len(body)))
            body[at : at + 4] = struct.pack(">f", float(rng.choice([np.nan, np.inf, -1e38, 0.0])))
        elif how == 5:
            del body[int(rng.integers(0, len(body) + 1)) :]
            if rng.random() < 0.5:
                struct.pack_into("> Q", header, SIZE_AT, len(body))
    if rng.random() < 0.5:
        struct.pack_into("> Q", header, CRC_AT, CRC64(bytes(body)))
    return bytes(header + body)


def received(content, pieces=7, limits=None):
    """What comes of a stream that arrives in pieces, and then stalls until nothing is expected of it."""
    framing, found = Framing(limits), []
    edges = np.linspace(0, len(content), pieces + 1).astype(int)
    for first, stop in itertools.pairwise(edges):
        found += framing.feed(content[first:stop])
    while framing.within_message:
        framing.skip()
        found += framing.feed(b"")
    return [each for each in found if not isinstance(each, MessageError)]
