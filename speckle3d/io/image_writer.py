"""Writing MetaImage and NRRD files: headers and pixels of volumes and of PLUS's sequences.

pynrrd refuses letters beyond ASCII (names of segments), and has no fields of frames.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.arrays import AnyArray
from speckle3d.io.header_fields import NUMBER_TYPES
from speckle3d.io.headers import DEFLATE, GZIP, ZLIB


def meta_header(
    shape: Sequence[int],
    dtype: np.dtype[Any],
    kinds: str,
    fields: Mapping[str, object],
    packed_bytes: int | None,
) -> str:
    """Header of a MetaImage of three axes; of packed pixels, with room for their size."""
    size = "" if packed_bytes is None else f"CompressedDataSize = {packed_bytes:<20}\n"
    return f"""ObjectType = Image
NDims = 3
BinaryData = True
BinaryDataByteOrderMSB = False
CompressedData = {bool(size)}
{size}DimSize = {" ".join(map(str, shape))}
ElementType = MET_{NUMBER_TYPES[dtype.str[1:]].split()[0].upper()}
Kinds = {kinds}
{_field_lines(fields, " = ")}ElementDataFile = LOCAL
"""


def nrrd_header(
    version: int, dtype: np.dtype[Any], axes: str, fields: Mapping[str, object], is_packed: bool
) -> str:
    """Header of an NRRD file; `axes` are lines that tell of them."""
    return f"""NRRD000{version}
type: {NUMBER_TYPES[dtype.str[1:]].split()[-1]}
{axes}
endian: little
encoding: {"gzip" if is_packed else "raw"}
{_field_lines(fields, ":=")}
"""


def _field_lines(fields: Mapping[str, object], sign: str) -> str:
    """A line for each field of a header."""
    return "".join(f"{name}{sign}{value}\n" for name, value in fields.items())


def write_image(
    path: Path,
    header: Callable[[int | None], str],
    planes: Iterable[AnyArray],
    is_packed: bool,
    is_nrrd: bool,
) -> None:
    """Write a header and pixels behind it, plane by plane, little-endian.

    Parameters
    ----------
    header : callable
        Makes the header, as long whatever the size of the packed pixels; None of raw ones.
    """
    # At higher levels speckle hardly shrinks further, and takes several times as long.
    pack = DEFLATE.compressobj(1, zlib.DEFLATED, GZIP if is_nrrd else ZLIB) if is_packed else None
    with path.open("wb") as file:
        start = file.write(_header_bytes(header(0 if is_packed else None)))
        for plane in planes:
            raw = plane.astype(plane.dtype.newbyteorder("<"), order="C", copy=False).data.cast("B")
            file.write(raw if pack is None else pack.compress(raw))
        if pack is not None:
            file.write(pack.flush())
            size = file.tell() - start
            file.seek(0)
            file.write(_header_bytes(header(size)))


def _header_bytes(header: str) -> bytes:
    """A header as bytes that are read back as the same text."""
    return header.encode("utf-8", "backslashreplace")
