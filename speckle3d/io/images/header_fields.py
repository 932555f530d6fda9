"""Fields of MetaImage and NRRD headers, both by NRRD's names, and the units and types they name.

pynrrd parses NRRD's headers; a MetaImage's fields are put into NRRD's words.

References
----------
.. [1] G. Kindlmann, "Definition of NRRD File Format", teem.sourceforge.net.
.. [2] ITK, "MetaIO documentation".
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import takewhile
from typing import Any, BinaryIO

import nrrd
import numpy as np

from speckle3d.core.errors import InvalidInputError
from speckle3d.io.text import numbers

_START = re.compile(rb"(?:\xef\xbb\xbf)?(?:NRRD000|(?:ObjectType|NDims|Comment|ObjectSubType)\s*=)")
_FRAME_FIELD = re.compile(r"Seq_Frame0*(\d{1,7})_(\w+)")
_MM_PER = {
    "": 1.0, "?": 1.0, "none": 1.0, "unknown": 1.0, "mm": 1.0, "millimeter": 1.0, "cm": 10.0,
    "centimeter": 10.0, "m": 1e3, "meter": 1e3, "um": 1e-3, "µm": 1e-3, "micrometer": 1e-3, "micron": 1e-3,
}  # fmt: skip
_S_PER = {"s": 1.0, "sec": 1.0, "second": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6}
"""Units by their names, which may have an s at their end."""
NUMBER_TYPES = {
    "i1": "char int8",
    "u1": "uchar uint8",
    "i2": "short int16",
    "u2": "ushort uint16",
    "i4": "int long int32",
    "u4": "uint ulong uint32",
    "i8": "long_long longlong int64",
    "u8": "ulong_long ulonglong uint64",
    "f4": "float",
    "f8": "double",
}
"""Types of numbers: first as MetaImage writes them, whose LONG has four bytes, last as NRRD does."""

NRRD_NAMES = {
    "ultrasound image orientation": "UltrasoundImageOrientation",
    "ultrasound image type": "UltrasoundImageType",
}
"""PLUS's fields by what it calls them in NRRD."""


def is_image(start: bytes) -> bool:
    """Whether a file's first bytes are those of a MetaImage or NRRD header."""
    return _START.match(start) is not None


def nrrd_fields(stream: BinaryIO) -> dict[str, Any]:
    """Fields of NRRD by their names, numbers as numbers; the stream is left behind them."""
    lines = [stream.readline().decode()]
    for line in takewhile(str.strip, _lines(stream)):
        name, sign, value = line.partition(":")
        if not value.startswith("="):
            # Fields of the format itself, unlike those of its users, may be in letters of any size.
            name = re.sub("^(data|byte|line)(?=file|skip)", r"\1 ", name.strip().lower())
        # Without a sign: names of files below "data file: LIST".
        lines += [f"{NRRD_NAMES.get(name, name)}{sign}{value}"] if sign else []
    fields: dict[str, Any] = {"sizes": (), "type": "", "encoding": ""}
    fields |= nrrd.read_header(lines)
    return fields


def meta_fields(stream: BinaryIO) -> dict[str, Any]:
    """Fields of a MetaImage by its own and by NRRD's names; the stream is left behind them."""
    fields: dict[str, Any] = {}
    for line in _lines(stream):
        name, _, value = map(str.strip, line.partition("="))
        fields[name] = value
        if name == "ElementDataFile":
            break

    def first(*names: str) -> str:
        return next((fields[name] for name in names if fields.get(name)), "")

    def is_set(*names: str) -> bool:
        return first(*names)[:1] in ("T", "t", "1")

    file, is_text = first("ElementDataFile"), "BinaryData" in fields and not is_set("BinaryData")
    # Of a file that holds its pixels itself, a size is that of the header.
    is_local, skip = file.upper() == "LOCAL", int(first("HeaderSize") or "0")
    words: dict[str, Any] = {
        "sizes": numbers(first("DimSize"), None, "DimSize"),
        "kinds": first("Kinds").split(),
        "type": first("ElementType"),
        "endian": "big" if is_set("BinaryDataByteOrderMSB", "ElementByteOrderMSB") else "little",
        "encoding": "gzip" if is_set("CompressedData") else "text" if is_text else "raw",
        "data file": "" if is_local else file,
        "byte skip": min(skip, 0) if is_local else skip,
        "channels": int(first("ElementNumberOfChannels") or "1"),
        "space units": [first("DistanceUnits")],
    }
    if steps := first("ElementSpacing", "ElementSize"):
        axes = np.diag(np.array(numbers(steps, len(words["sizes"]), "ElementSpacing")))
        if rotation := first("TransformMatrix", "Rotation", "Orientation"):
            axes = axes @ np.reshape(numbers(rotation, axes.size, "TransformMatrix"), axes.shape)
        words["space directions"] = axes
    if place := first("Offset", "Position", "Origin"):
        words["space origin"] = np.array(numbers(place, None, "Offset"))
    return fields | words


def frame_fields(lines: dict[str, Any]) -> tuple[dict[str, str], dict[int, dict[str, str]]]:
    """Texts of the file, and of frames by their numbers."""
    fields, frames = dict[str, str](), dict[int, dict[str, str]]()
    for name, value in lines.items():
        if match := _FRAME_FIELD.fullmatch(name):
            frames.setdefault(int(match[1]), {})[match[2]] = value
        elif isinstance(value, str):
            fields[name] = value
    return fields, frames


def number_type(word: str, is_big: bool) -> np.dtype[Any]:
    """Type of numbers by a word of either format, as ``MET_UCHAR`` or ``unsigned char``."""
    plain = word.lower().removeprefix("met_").removesuffix("_t").replace("unsigned ", "u")
    plain = plain.replace("signed ", "").removesuffix(" int").replace(" ", "")
    for kind, words in NUMBER_TYPES.items():
        if plain in words.split():
            return np.dtype((">" if is_big else "<") + kind)
    raise InvalidInputError(f"type: expected a type of numbers as uint8 or MET_UCHAR, got {word!r}")


def mm_per(unit: str) -> float:
    """Millimetres of a unit of length; what names none is in mm.

    Raises
    ------
    InvalidInputError
        If the unit is not known.
    """
    factor = _MM_PER.get(_singular(unit))
    if factor is None:
        raise InvalidInputError(f"expected a unit as mm, cm, m or um, got {unit}")
    return factor


def s_per(unit: str) -> float | None:
    """Seconds of a unit of time; None of another."""
    return _S_PER.get(_singular(unit))


def _singular(unit: str) -> str:
    return unit.lower() if len(unit) < 4 else unit.lower().removesuffix("s")


def _lines(stream: BinaryIO) -> Iterator[str]:
    for line in stream:
        try:
            yield line.decode("utf-8-sig").rstrip("\r\n")
        except UnicodeDecodeError:
            yield line.decode("latin-1").rstrip("\r\n")
