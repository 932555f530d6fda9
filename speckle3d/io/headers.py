"""Reading MetaImage and NRRD files: headers, with the per-frame fields that PLUS writes, and pixels.

pynrrd parses NRRD's headers, and a MetaImage's fields are put into NRRD's words. Pixels are read here: pynrrd
reads all of a raw sequence into memory and stops at the first member of packed pixels.

References
----------
.. [1] G. Kindlmann, "Definition of NRRD File Format", teem.sourceforge.net.
.. [2] ITK, "MetaIO documentation".
"""

from __future__ import annotations

import bz2
import math
import re
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import nrrd
import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import FileError, InvalidInputError, naming
from speckle3d.core.files import PathLike, open_regular
from speckle3d.io.hdf5 import reading
from speckle3d.io.text import numbers

DEFLATE: Any = zlib
try:
    from isal import isal_zlib

    DEFLATE = isal_zlib
except ImportError:
    pass

ZLIB, GZIP, _EITHER = 15, 31, 47
"""Windows of deflate, and by them what is around it; either is told when unpacking."""

_FRAME_FIELD = re.compile(r"Seq_Frame0*(\d{1,7})_(\w+)")
_MM_PER = {
    "": 1.0, "?": 1.0, "none": 1.0, "unknown": 1.0, "mm": 1.0, "millimeter": 1.0, "cm": 10.0,
    "centimeter": 10.0, "m": 1e3, "meter": 1e3, "um": 1e-3, "µm": 1e-3, "micrometer": 1e-3, "micron": 1e-3,
}  # fmt: skip
_S_PER = {"s": 1.0, "sec": 1.0, "second": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6}
"""Units by their names, which may have an s at their end."""
_SPACE, _TIME = ("domain", "space", "", "???", "none", "?"), ("list", "time")
_PACKINGS = {"ra": "raw", "gz": "deflate", "bz": "bzip2", "tx": "text", "te": "text", "as": "text"}
"""By how NRRD's words for them begin, as bzip2 or bz2."""
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


@dataclass(frozen=True)
class SequenceHeader:
    """What the header of an image file says.

    Attributes
    ----------
    container : str
        Kind of the file, ``"MetaImage"`` or ``"NrrdImage"``.
    fields : dict
        Texts of the whole file.
    frames : tuple of dict
        Fields of each frame, without the ``Seq_FrameNNNN_`` before their names; empty for a plain image.
    size : tuple of int
        Lengths of the image's axes, fastest first, and the number of frames if there is an axis for them.
    spacing_mm : tuple of float, or None
        Of the first two axes; None where the header holds the pixel unit 1 that stands for "unknown".
    stored : tuple of int
        Lengths of all axes in the file, fastest first.
    frame_axis : int, optional
        Of `stored`.
    is_volume : bool
        Whether all three axes are of space, as they say and frames' fields do not contradict.
    channels : int
        Numbers a pixel.
    index_s : ndarray, shape (n,), optional
        Times of the frames by their axis.
    axes_mm : ndarray, shape (axis, coordinate), optional
        Step along each axis, in a space whose axes lead left, posterior and superior; NaN of an axis that
        has none.
    origin_mm : ndarray, shape (coordinate,), optional
        Centre of the first pixel.
    dtype : dtype
        Of the numbers in the file.
    data : path
        Of the file that holds the pixels: the header's own, or one in its folder.
    start : int
        First byte of the pixels, or of `skipped_lines` lines of text before them; -1 where they are last.
    packing : str
        ``"raw"``, ``"deflate"``, ``"bzip2"`` or ``"text"``.
    """

    path: str
    container: str
    fields: dict[str, str]
    frames: tuple[dict[str, str], ...]
    size: tuple[int, ...]
    spacing_mm: tuple[float, ...] | None
    stored: tuple[int, ...]
    frame_axis: int | None
    is_volume: bool
    channels: int
    index_s: FloatArray | None
    axes_mm: FloatArray | None
    origin_mm: FloatArray | None
    dtype: np.dtype[Any]
    data: Path
    start: int
    packing: str
    skipped_lines: int

    @property
    def frame_count(self) -> int:
        """Frames, from the third axis; a plane image is one frame."""
        return self.size[2] if len(self.size) > 2 else 1

    def images(self) -> npt.NDArray[Any]:
        """Map or unpack all images, shape (frame, y, x).

        Raises
        ------
        FileError
            If pixels are damaged or missing.
        """
        values = self.numbers().reshape(self.stored[::-1])
        if self.frame_axis is not None:
            values = np.moveaxis(values, len(self.stored) - 1 - self.frame_axis, 0)
        return values.reshape(self.frame_count, self.size[1], self.size[0])

    def numbers(self) -> npt.NDArray[Any]:
        """Map or unpack the numbers, in one row; raw ones of the machine's byte order stay on the disk.

        Raises
        ------
        FileError
            If the file cannot be read, is damaged, or holds fewer.
        """
        count = math.prod(self.size) * self.channels
        size_bytes = count * self.dtype.itemsize
        with reading(self.path, DEFLATE.error), open_regular(self.data) as stream:
            length = stream.seek(0, 2)
            stream.seek(max(length - size_bytes, 0) if self.start < 0 else self.start)
            for _ in range(self.skipped_lines):
                stream.readline()
            if self.packing == "text":
                values = np.array(stream.read().split(), dtype=np.float64).astype(self.dtype)
            elif self.packing == "raw" and count and stream.tell() + size_bytes <= length:
                values = np.memmap(self.data, self.dtype, "r", stream.tell(), (count,))
            else:
                content = stream.read() if self.packing == "raw" else _unpacked(stream.read(), self.packing)
                values = np.frombuffer(content, self.dtype, len(content) // self.dtype.itemsize)
        if values.size < count:
            whole = values.size * self.frame_count // count
            raise FileError(f"{self.path}: ends early: {whole} of {self.frame_count} frames")
        return values[:count].astype(self.dtype.newbyteorder("="), copy=False)


def _unpacked(packed: bytes, packing: str) -> bytes:
    """Unpack all; members of gzip that follow one another are one stream."""
    content = bytearray()
    while packed:
        stream = bz2.BZ2Decompressor() if packing == "bzip2" else DEFLATE.decompressobj(_EITHER)
        content += stream.decompress(packed)
        packed = stream.unused_data if stream.unused_data[:2] == b"\x1f\x8b" else b""
    return bytes(content)


def is_image(start: bytes) -> bool:
    """Whether a file's first bytes are those of a MetaImage or NRRD header."""
    first = start.split(b"\n", 1)[0].partition(b"=")[0].strip()
    return start.startswith(b"NRRD000") or first in (b"ObjectType", b"NDims", b"Comment", b"ObjectSubType")


def read_header(path: PathLike) -> SequenceHeader:
    """Read the text header of a MetaImage or NRRD file.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If it is neither, the header does not make sense, or its pixels lie outside its folder.
    """
    with reading(path, nrrd.NRRDError), open_regular(path) as stream, naming(str(path)):
        start = stream.read(512)
        if not is_image(start):
            raise InvalidInputError("expected a MetaImage or NRRD header, got something else")
        stream.seek(0)
        is_nrrd = start.startswith(b"NRRD")
        return _header(Path(path), (_nrrd_words if is_nrrd else _meta_words)(stream), is_nrrd, stream.tell())


def mm_per(unit: str) -> float:
    """Millimetres of a unit of length; what names none is in mm.

    Raises
    ------
    InvalidInputError
        If the unit is not known.
    """
    factor = _MM_PER.get(_plain(unit))
    if factor is None:
        raise InvalidInputError(f"expected a unit as mm, cm, m or um, got {unit}")
    return factor


def _plain(unit: str) -> str:
    return unit.lower() if len(unit) < 4 else unit.lower().removesuffix("s")


def _lines(stream: BinaryIO) -> Iterator[str]:
    for line in stream:
        try:
            yield line.decode("utf-8").rstrip("\r\n")
        except UnicodeDecodeError:
            yield line.decode("latin-1").rstrip("\r\n")


def _nrrd_words(stream: BinaryIO) -> dict[str, Any]:
    """Fields of NRRD by their names, numbers as numbers."""
    lines, is_whole = dict[str, str](), False
    magic = stream.readline().decode()
    for line in _lines(stream):
        if is_whole := not line.strip():
            break
        name, sign, value = line.partition(":")
        if not value.startswith("="):
            # Fields of the format itself, unlike those of its users, may be in letters of any size.
            name = re.sub("^(data|byte|line)(?=file|skip)", r"\1 ", name.strip().lower())
        lines[name] = f"{NRRD_NAMES.get(name, name)}{sign}{value}"
    words: dict[str, Any] = nrrd.read_header([magic, *lines.values()])
    if not (is_whole or "data file" in words):
        raise InvalidInputError("expected an NRRD header up to an empty line, got a truncated one")
    return words


def _meta_words(stream: BinaryIO) -> dict[str, Any]:
    """Fields of a MetaImage, and what they say in NRRD's words."""
    fields: dict[str, Any] = {}
    for line in _lines(stream):
        name, _, value = line.partition("=")
        fields[name.strip()] = value.strip()
        if "ElementDataFile" in fields:
            break
    else:
        raise InvalidInputError("expected a MetaImage header up to ElementDataFile, got a truncated one")

    def first(*names: str) -> str:
        return next((fields[name] for name in names if fields.get(name)), "")

    def is_set(*names: str) -> bool:
        return first(*names)[:1] in ("T", "t", "1")

    file, skipped = first("ElementDataFile"), int(first("HeaderSize") or "0")
    is_text = "BinaryData" in fields and not is_set("BinaryData")
    words: dict[str, Any] = {
        "sizes": [*map(int, first("DimSize").split())],
        "kinds": first("Kinds").split(),
        "type": first("ElementType"),
        "endian": "big" if is_set("BinaryDataByteOrderMSB", "ElementByteOrderMSB") else "little",
        "encoding": "gzip" if is_set("CompressedData") else "text" if is_text else "raw",
        "data file": file,
        "byte skip": skipped,
        "channels": int(first("ElementNumberOfChannels") or "1"),
        "space units": [first("DistanceUnits")],
    }
    if file.upper() == "LOCAL":
        words |= {"data file": "", "byte skip": min(skipped, 0)}
    if steps := first("ElementSpacing", "ElementSize"):
        axes = np.diag(np.array(numbers(steps, len(words["sizes"]), "ElementSpacing")))
        if turn := first("TransformMatrix", "Rotation", "Orientation"):
            axes = axes @ np.reshape(numbers(turn, axes.size, "TransformMatrix"), axes.shape)
        words["space directions"] = axes
    if place := first("Offset", "Position", "Origin"):
        words["space origin"] = np.array(numbers(place, None, "Offset"))
    return fields | words


def _header(path: Path, words: dict[str, Any], is_nrrd: bool, start: int) -> SequenceHeader:
    """Tell axes of the image, of frames and of colours by their kinds; without, as PLUS orders them."""
    stored = tuple(map(int, words["sizes"]))
    stated = [kind.lower() for kind in words.get("kinds", ())]
    kinds = stated if len(stated) == len(stored) else ["domain"] * len(stored)
    spatial = [i for i, kind in enumerate(kinds) if kind in _SPACE]
    frame_axis = next((i for i, kind in enumerate(kinds) if kind in _TIME), None)
    colours = {*range(len(stored))} - {*spatial, frame_axis}
    if frame_axis is None and len(spatial) == 3:
        frame_axis = spatial.pop()
    if len(spatial) == 3:  # images of 3D Slicer are a pixel thick
        thin = next((i for i in reversed(spatial) if stored[i] == 1), None)
        spatial = [i for i in spatial if i != thin]
    if len(spatial) != 2 or min(stored) < 0:
        raise InvalidInputError(
            f"sizes: expected images on two axes and at most one of frames, got lengths "
            f"{' '.join(map(str, stored))} of kinds {' '.join(kinds)}"
        )
    size = tuple(stored[i] for i in (*spatial, frame_axis) if i is not None)
    axes, origin = _placed(words, len(stored))
    spacing = None if axes is None else (*np.linalg.norm(axes, axis=1)[spatial].tolist(),)
    if spacing is not None and (not all(0 < step < math.inf for step in spacing) or spacing == (1.0, 1.0)):
        spacing = None  # PLUS and ITK write 1 where nobody told them
    own, frames = _split({name: text for name, text in words.items() if isinstance(text, str)})
    if len(frames) == (*size, 0)[2] + 1 and not frames[0]:
        frames = frames[1:]  # of a writer that counts from 1
    word = words["type"] if 0 not in stored else "uchar"  # a tracker's may name no type
    packing = _PACKINGS.get(words["encoding"].lower()[:2])
    if packing is None:
        raise InvalidInputError(f"encoding: expected raw, gzip, bzip2 or text, got {words['encoding']!r}")
    file, skipped = words.get("data file", ""), words.get("byte skip", 0)
    data, start = (_beside(path, file), 0) if file else (path, start)
    return SequenceHeader(
        str(path), "NrrdImage" if is_nrrd else "MetaImage", own, frames, size, spacing, stored, frame_axis,
        len(stated) == 3 == len(stored) and {*stated} <= {"domain", "space"} and len(frames) < size[2],
        math.prod(stored[i] for i in colours if i is not None) * words.get("channels", 1),
        None if frame_axis is None else _frame_times(words, frame_axis, size[2]), axes, origin,
        _number_type(word, words.get("endian", "").lower() == "big"), data,
        -1 if skipped < 0 else start + skipped, packing, words.get("line skip", 0),
    )  # fmt: skip


def _placed(words: Mapping[str, Any], count: int) -> tuple[FloatArray | None, FloatArray | None]:
    """Steps along the axes and the place of the first pixel, where they are said; see `SequenceHeader`."""
    units = words.get("units", [])
    spaces = words.get("space units") or [unit for unit in units if _plain(unit) not in _S_PER]
    scale: FloatArray = mm_per("".join(spaces[:1])) * np.ones(max(count, 3))
    space = words.get("space", "").lower()
    letters = "".join(word[0] for word in space.split("-")) if "-" in space else space
    scale[:2] *= [-1.0 if letters[:1] == "r" else 1.0, -1.0 if letters[1:2] == "a" else 1.0]
    axes, origin = words.get("space directions"), words.get("space origin")
    if (steps := words.get("spacings")) is not None:
        of_space = [1.0 if _plain(unit) in _S_PER else mm_per(unit) for unit in units]
        axes = np.diag(steps * np.array(of_space or 1.0))
    elif axes is not None:
        axes = axes * scale[: axes.shape[1]]
    if axes is not None and len(axes) != count:
        raise InvalidInputError(f"expected a spacing for each of {count} axes, got {len(axes)}")
    if origin is not None:
        origin = origin * scale[: len(origin)]
    return axes, origin


def _frame_times(words: Mapping[str, Any], axis: int, count: int) -> FloatArray | None:
    """Times of frames by their axis: its index, as 3D Slicer writes it, or its spacing in a unit of time."""
    s_per = _S_PER.get(_plain("".join(words.get("units", ())[axis : axis + 1])))
    index, steps = words.get(f"axis {axis} index values", "").split(), words.get("spacings")
    if words.get(f"axis {axis} index type", "numeric") == "numeric" and len(index) == count:
        return np.array(index, dtype=float) * (s_per or 1.0)
    if s_per and steps is not None and steps[axis] > 0:
        return np.arange(float(count)) * float(steps[axis]) * s_per
    return None


def _number_type(word: str, is_big: bool) -> np.dtype[Any]:
    """Type of numbers by a word of either format, as ``MET_UCHAR`` or ``unsigned char``."""
    plain = word.lower().removeprefix("met_").removesuffix("_t").replace("unsigned ", "u")
    plain = plain.replace("signed ", "").removesuffix(" int").replace(" ", "")
    for kind, words in NUMBER_TYPES.items():
        if plain in words.split():
            return np.dtype((">" if is_big else "<") + kind)
    raise InvalidInputError(f"type: expected a type of numbers as uint8 or MET_UCHAR, got {word!r}")


def _split(lines: dict[str, str]) -> tuple[dict[str, str], tuple[dict[str, str], ...]]:
    """Fields of the file, and of each frame; none of a frame that the header leaves out."""
    frames: dict[int, dict[str, str]] = {}
    fields = {}
    for name, value in lines.items():
        if match := _FRAME_FIELD.fullmatch(name):
            frames.setdefault(int(match[1]), {})[match[2]] = value
        else:
            fields[name] = value
    return fields, tuple(frames.get(i, {}) for i in range(max(frames, default=-1) + 1))


def _beside(path: Path, name: str) -> Path:
    """Path of a data file, which lies in the header's folder: a stranger's header names no other."""
    folder, words = path.parent.resolve(), name.split()
    data = (folder / name).resolve()
    if words[0] == "LIST" or ("%" in name and len(words) > 1) or not data.is_relative_to(folder):
        raise InvalidInputError(f"expected pixels in one file in the header's own folder, got {name!r}")
    return data
