"""Writing MetaImage and NRRD files: headers and pixels of volumes and of PLUS's sequences.

pynrrd refuses letters beyond ASCII (names of segments), and has no fields of frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.arrays import AnyArray
from speckle3d.io.images.headers import DEFLATE, GZIP, NUMBER_TYPES, ZLIB


def write_image(
    path: Path,
    planes: Iterable[AnyArray],
    shape: Sequence[int],
    dtype: np.dtype[Any],
    axes: str,
    fields: Mapping[str, str],
    is_packed: bool = False,
) -> None:
    """Write a header and pixels behind it, plane by plane, little-endian; the suffix chooses the format.

    Parameters
    ----------
    shape : sequence of int
        Lengths of the axes, fastest first.
    axes : str
        Lines of the format's own fields about the axes.
    fields : mapping of str to str
        All others.
    is_packed : bool
        Whether pixels are packed with deflate, at its lowest level: at higher ones speckle hardly shrinks
        further, and takes several times as long.
    """
    is_nrrd, words = path.suffix == ".nrrd", NUMBER_TYPES[dtype.str[1:]].split()
    pack = DEFLATE.compressobj(1, DEFLATE.DEFLATED, GZIP if is_nrrd else ZLIB) if is_packed else None
    sizes = " ".join(map(str, shape))

    def header(packed_bytes: int) -> bytes:
        """As long whatever the size of the packed pixels; read back as the same text."""
        size = f"CompressedDataSize = {packed_bytes:<20}\n" if is_packed else ""
        text = f"""ObjectType = Image
NDims = {len(shape)}
BinaryData = True
BinaryDataByteOrderMSB = False
CompressedData = {is_packed}
{size}DimSize = {sizes}
ElementType = MET_{words[0].upper()}
{axes}
{_lines(fields, " = ")}ElementDataFile = LOCAL
"""
        if is_nrrd:
            text = f"""NRRD0004
type: {words[-1]}
dimension: {len(shape)}
sizes: {sizes}
{axes}
endian: little
encoding: {"gzip" if is_packed else "raw"}
{_lines(fields, ":=")}
"""
        return text.encode("utf-8", "backslashreplace")

    with path.open("wb") as file:
        start = file.write(header(0))
        for plane in planes:
            raw = plane.astype(plane.dtype.newbyteorder("<"), order="C", copy=False).data.cast("B")
            file.write(raw if pack is None else pack.compress(raw))
        if pack is not None:
            file.write(pack.flush())
            size = file.tell() - start
            file.seek(0)
            file.write(header(size))


def _lines(fields: Mapping[str, object], sign: str) -> str:
    return "".join(f"{name}{sign}{value}\n" for name, value in fields.items())
