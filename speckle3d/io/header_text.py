"""What the text headers of MetaImage and NRRD files have in common when they are written."""

from __future__ import annotations

from collections.abc import Iterable
from typing import BinaryIO

_SIZE_FIELD = "CompressedDataSize = "
_SIZE_PLACE = 20
"""Characters kept in a MetaImage's header for the size of the packed pixels, which is known after them."""


def header_bytes(lines: Iterable[str]) -> bytes:
    """Lines of a header as bytes that are read back as the same text."""
    return "".join(f"{line}\n" for line in lines).encode("utf-8", "backslashreplace")


def meta_start(axes: int, packed_size: int | None) -> list[str]:
    """First lines of a MetaImage's header.

    Parameters
    ----------
    axes : int
    packed_size : int or None
        Bytes of the packed pixels, 0 if `put_packed_size` tells them later; None if they are not packed.
    """
    return [
        "ObjectType = Image",
        f"NDims = {axes}",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        f"CompressedData = {packed_size is not None}",
        *([] if packed_size is None else [_packed_size_line(packed_size)]),
    ]


def put_packed_size(file: BinaryIO, header: bytes, size: int) -> None:
    """Write the size of the packed pixels where a file, which begins with the header, has room for it."""
    file.seek(header.index(_SIZE_FIELD.encode()))
    file.write(_packed_size_line(size).encode())


def _packed_size_line(size: int) -> str:
    return f"{_SIZE_FIELD}{str(size).ljust(_SIZE_PLACE)}"
