"""MetaImage and NRRD files: axes, units, fields of frames, pixels.

pynrrd parses NRRD's headers; a MetaImage's fields are put into NRRD's words. The rest is done here: pynrrd
reads all of a raw sequence into memory, stops at the first member of packed pixels, refuses letters beyond
ASCII (names of segments) when it writes, and has no fields of frames.

References
----------
.. [1] G. Kindlmann, "Definition of NRRD File Format", teem.sourceforge.net.
.. [2] ITK, "MetaIO documentation".
"""

import bz2
import math
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import nrrd
import numpy as np

from speckle3d.core.arrays import AnyArray, FloatArray
from speckle3d.core.errors import FileError, InvalidInputError, naming
from speckle3d.core.files import PathLike, open_regular
from speckle3d.io.hdf5 import reading
from speckle3d.io.text import numbers

try:
    from isal import isal_zlib
except ImportError:
    import zlib as isal_zlib  # type: ignore[no-redef]
_ZLIB, _GZIP, _EITHER = 15, 31, 47
"""Windows of deflate, and by them what is around it; either is told when unpacking."""

_NUMBER_TYPES = {
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

_SYNONYMS = {
    "Rotation": "TransformMatrix", "Orientation": "TransformMatrix", "Position": "Offset", "Origin": "Offset",
    "ElementByteOrderMSB": "BinaryDataByteOrderMSB",
}  # fmt: skip
"""Fields of MetaImage by their other names."""

RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
"""World of NIfTI, 3D Slicer and OpenIGTLink (right, anterior, superior) from that of images and volumes."""

_START = re.compile(rb"(?:\xef\xbb\xbf)?(?:NRRD000|(?:ObjectType|NDims|Comment|ObjectSubType)\s*=)")
_FRAME_FIELD = re.compile(r"Seq_Frame0*(\d{1,7})_(\w+)")
_MM_PER = {
    1.0: "mm millimeter none unknown ?",
    10.0: "cm centimeter",
    1e3: "m meter",
    1e-3: "um µm micrometer micron",
}
_S_PER = {1.0: "s sec second", 1e-3: "ms msec", 1e-6: "us"}
"""Names of units, which may have an s at their end."""
_ENCODINGS = {"raw": "raw", "deflate": "gz gzip", "bzip2": "bz2 bzip2", "text": "text txt ascii"}
_Key = TypeVar("_Key")
_SPACE, _TIME = ("domain", "space", "", "???", "none", "?"), ("list", "time")
"""Kinds of axes."""


@dataclass(frozen=True)
class SequenceHeader:
    """Contents of the header of an image file.

    Attributes
    ----------
    container : str
        Kind of the file, ``"MetaImage"`` or ``"NrrdImage"``.
    fields : dict
        Texts of the whole file.
    frames : dict of int to dict
        Fields of frames by their number, without the ``Seq_FrameNNNN_`` before their names.
    file_size : tuple of int
        Lengths of all axes in the file, fastest first.
    order : tuple of int
        Axes of the file that are the image's, fastest first, and that of the frames if there is one.
    spacing_mm : tuple of float, or None
        Of the first two axes; None where the header holds the pixel unit 1 that stands for "unknown".
    is_volume : bool
        Whether all three axes are of space, as they say and frames' fields do not contradict.
    channels : int
        Numbers a pixel.
    axis_times_s : ndarray, shape (n,), optional
        Times of the frames by their axis, NaN beyond its index.
    axes_mm : ndarray, shape (axis, coordinate), optional
        Step along each axis, in a space whose axes lead left, posterior and superior; NaN of an axis that
        has none.
    origin_mm : ndarray, shape (coordinate,), optional
        Centre of the first pixel.
    dtype : dtype
        Of the numbers in the file.
    data : path
        Of the file that holds the pixels.
    start : int
        First byte of the pixels; -1 where they are last.
    encoding : str
        ``"raw"``, ``"deflate"``, ``"bzip2"`` or ``"text"``.
    """

    path: str
    container: str
    fields: dict[str, str]
    frames: dict[int, dict[str, str]]
    file_size: tuple[int, ...]
    order: tuple[int, ...]
    spacing_mm: tuple[float, ...] | None
    is_volume: bool
    channels: int
    axis_times_s: FloatArray | None
    axes_mm: FloatArray | None
    origin_mm: FloatArray | None
    dtype: np.dtype[Any]
    data: Path
    start: int
    encoding: str

    @property
    def size(self) -> tuple[int, ...]:
        """Lengths of the image's axes, fastest first, and the number of frames if they have an axis."""
        return tuple(self.file_size[i] for i in self.order)

    @property
    def has_images(self) -> bool:
        """Whether images have more than a line; a tracker's recording has none, or a pixel a frame."""
        return 0 not in self.size and max(self.size[:2]) > 1

    @property
    def frame_count(self) -> int:
        """Frames, from the third axis, and of a tracker's recording at least those with fields."""
        count = (*self.size, 1)[2]
        return count if self.has_images else max(count, len(self.frames))

    def column(self, name: str) -> dict[int, str]:
        """Text of each frame that has a field of this name, by its number."""
        rows = self.frames.items()
        return {i: frame[name] for i, frame in rows if i < self.frame_count and name in frame}

    def values(self, name: str, count: int) -> FloatArray:
        """Numbers of a field of each frame, shape (n, count); NaN where there are none that make sense."""
        values = np.full((self.frame_count, count), np.nan)
        for i, text in self.column(name).items():
            with suppress(InvalidInputError):
                values[i] = numbers(text, count, name)
        return values

    def images(self) -> AnyArray:
        """Map or unpack all images of one channel, shape (frame, y, x).

        Raises
        ------
        FileError
            If pixels are damaged or missing.
        """
        others = {*range(len(self.file_size))} - {*self.order}
        values = self.numbers().reshape(self.file_size, order="F").transpose(*others, *self.order[::-1])
        return values.reshape(self.frame_count, self.size[1], self.size[0])

    def numbers(self) -> AnyArray:
        """Map or unpack the numbers, in one row, of the file's byte order; raw ones stay on the disk.

        Raises
        ------
        FileError
            If the file cannot be read, is damaged, or holds fewer.
        """
        count = math.prod(self.size) * self.channels
        size, values = count * self.dtype.itemsize, np.zeros(0, self.dtype)
        with reading(self.path, Exception), open_regular(self.data) as stream:
            length = stream.seek(0, 2)
            start = max(length - size, 0) if self.start < 0 else self.start
            stream.seek(start)
            if self.encoding == "text":
                values = np.array(stream.read().split(), dtype=np.float64).astype(self.dtype)
            elif self.encoding != "raw":
                content = _unpack(stream.read(), self.encoding)
                values = np.frombuffer(content, self.dtype, len(content) // self.dtype.itemsize)
            elif (whole := min(length - start, size) // self.dtype.itemsize) > 0:
                values = np.memmap(self.data, self.dtype, "r", start, (whole,))
        if values.size < count:
            whole = values.size * self.frame_count // count
            raise FileError(f"{self.path}: ends early: {whole} of {self.frame_count} frames")
        return values[:count]


def _unpack(content: bytes, encoding: str) -> bytes:
    """Decompress the content; several gzip members are one stream."""
    if encoding == "bzip2":
        return bz2.decompress(content)
    plain = bytearray()
    while content:
        stream = isal_zlib.decompressobj(_EITHER)
        plain += stream.decompress(content)
        content = stream.unused_data if stream.unused_data[:2] == b"\x1f\x8b" else b""
    return bytes(plain)


def is_image(start: bytes) -> bool:
    """Whether a file's first bytes are those of a MetaImage or NRRD header."""
    return _START.match(start) is not None


def read_header(path: PathLike) -> SequenceHeader:
    """Read the text header of a MetaImage or NRRD file; axes are of image, frames and colours by their kinds.

    Without kinds they are ordered as PLUS orders them.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If it is neither, or the header does not make sense.
    """
    data = Path(path)
    # Fields of a damaged header may be texts where numbers are expected, or of other axes than the sizes.
    with reading(path, TypeError, LookupError), open_regular(path) as stream, naming(str(path)):
        is_nrrd = stream.peek().startswith(b"NRRD")
        words = (_nrrd_words if is_nrrd else _meta_words)(stream)
        sizes = tuple(map(int, words["sizes"]))
        kinds = [kind.lower() for kind in words.get("kinds", ())]
        if len(kinds) != len(sizes):
            kinds = [""] * len(sizes)
        sides = [i for i, kind in enumerate(kinds) if kind in _SPACE]
        frame_axes = [i for i, kind in enumerate(kinds) if kind in _TIME][:1]
        if not frame_axes and len(sides) > 2:
            frame_axes = [sides.pop()]
        if len(sides) == 3:  # images of 3D Slicer are a pixel thick
            thin = [i for i in sides if sizes[i] == 1][-1:]
            sides = [i for i in sides if i not in thin]
        if len(sides) != 2 or min(sizes) < 0:
            raise InvalidInputError(
                "sizes: expected images on two axes and at most one of frames, not volumes in a row or "
                f"segments in layers, got lengths {' '.join(map(str, sizes))} of kinds {' '.join(kinds)}"
            )
        order = *sides, *frame_axes
        axes, origin = _placement(words, len(sizes))
        spacing = None if axes is None else (*np.linalg.norm(axes, axis=1)[sides].tolist(),)
        if spacing is not None and (not all(0 < step < math.inf for step in spacing) or spacing == (1, 1)):
            spacing = None  # PLUS and ITK write 1 where nobody told them
        fields: dict[str, str] = {}
        frames: dict[int, dict[str, str]] = defaultdict(dict)
        for name, value in words.items():
            if match := _FRAME_FIELD.fullmatch(name):
                frames[int(match[1])][match[2]] = value
            elif isinstance(value, str):
                fields[name] = value
        count = sizes[frame_axes[0]] if frame_axes else 1
        if 0 not in frames and count in frames:  # of a writer that counts from 1
            frames = {number - 1: frame for number, frame in frames.items()}
        others = (sizes[i] for i in range(len(sizes)) if i not in order)
        channels = math.prod(others) * words["channels"]
        is_volume = len(sizes) == 3 and {*kinds} <= {"domain", "space"} and len(frames) < count
        if (encoding := _key(_ENCODINGS, words["encoding"].lower())) is None:
            raise InvalidInputError(f"encoding: expected raw, gzip, bzip2 or text, got {words['encoding']!r}")
        start, skip = stream.tell(), words.get("byte skip", 0)
        if file := words.get("data file"):
            folder, data, start = data.parent, data.parent / file, 0
            own, place = {os.path.abspath(folder), os.path.realpath(folder)}, Path(os.path.abspath(data))
            if own.isdisjoint(map(str, place.parents)):
                raise InvalidInputError(f"expected pixels in the header's folder or below it, got {file}")
        if data.exists() and count > (room := data.stat().st_size):
            raise InvalidInputError(f"expected {count} frames, got {room} bytes in {data.name}")
        if lines := words.get("line skip", 0):
            with open_regular(data) as pixels:
                pixels.seek(start)
                start += sum(len(pixels.readline()) for _ in range(lines))
        return SequenceHeader(
            str(path),
            "NrrdImage" if is_nrrd else "MetaImage",
            fields,
            frames,
            sizes,
            order,
            spacing,
            is_volume,
            channels,
            _axis_times(words, frame_axes[0], sizes) if frame_axes else None,
            axes,
            origin,
            # A tracker's recording may name no type.
            _number_type("uchar" if 0 in sizes else words["type"], words.get("endian", "").lower() == "big"),
            data,
            -1 if skip < 0 else start + skip,
            encoding,
        )


def _nrrd_words(stream: BinaryIO) -> dict[str, Any]:
    """Fields of NRRD by their names, numbers as numbers; the stream is left behind them."""
    lines = [stream.readline().decode()]
    for line in takewhile(str.strip, _lines(stream)):
        name, sign, value = line.partition(":")
        if not value.startswith("="):
            # Fields of the format itself, unlike those of its users, may be in letters of any size.
            name = re.sub("^(data|byte|line)(?=file|skip)", r"\1 ", name.strip().lower())
        # Without a sign: names of files below "data file: LIST".
        lines += [f"{NRRD_NAMES.get(name, name)}{sign}{value}"] if sign else []
    with reading(stream.name, Exception):  # whatever pynrrd stumbles over
        return {"sizes": (), "type": "", "encoding": "", **nrrd.read_header(lines), "channels": 1}


def _meta_words(stream: BinaryIO) -> dict[str, Any]:
    """Fields of a MetaImage by its own and by NRRD's names; the stream is left behind them."""
    fields = dict[str, str]()
    for line in _lines(stream):
        name, _, value = map(str.strip, line.partition("="))
        fields[_SYNONYMS.get(name, name)] = value
        if name == "ElementDataFile":
            break
    texts = defaultdict(str, {"BinaryData": "True"} | fields)

    def is_set(name: str) -> bool:
        return texts[name][:1] in ("T", "t", "1")

    file, is_text = texts["ElementDataFile"], not is_set("BinaryData")
    # Of a file that holds its pixels itself, a size is that of the header.
    is_local, skip = file.upper() == "LOCAL", int(texts["HeaderSize"] or 0)
    words: dict[str, Any] = {
        "sizes": numbers(texts["DimSize"], None, "DimSize"),
        "kinds": texts["Kinds"].split(),
        "type": texts["ElementType"],
        "endian": "big" if is_set("BinaryDataByteOrderMSB") else "little",
        "encoding": "gzip" if is_set("CompressedData") else "text" if is_text else "raw",
        "data file": "" if is_local else file,
        "byte skip": min(skip, 0) if is_local else skip,
        "channels": int(texts["ElementNumberOfChannels"] or 1),
        "space units": [texts["DistanceUnits"]],
    }
    if steps := texts["ElementSpacing"] or texts["ElementSize"]:
        axes = np.diag(numbers(steps, len(words["sizes"]), "ElementSpacing"))
        if rotation := texts["TransformMatrix"]:
            axes = axes @ np.reshape(numbers(rotation, axes.size, "TransformMatrix"), axes.shape)
        words["space directions"] = axes
    if place := texts["Offset"]:
        words["space origin"] = np.array(numbers(place, None, "Offset"))
    return fields | words


def _number_type(word: str, is_big: bool) -> np.dtype[Any]:
    """Type of numbers by a word of either format, as ``MET_UCHAR`` or ``unsigned char``."""
    plain = word.lower().removeprefix("met_").removesuffix("_t").replace("unsigned ", "u")
    kind = _key(_NUMBER_TYPES, plain.replace("signed ", "").removesuffix(" int").replace(" ", ""))
    if kind is None:
        raise InvalidInputError(f"type: expected a type of numbers as uint8 or MET_UCHAR, got {word!r}")
    return np.dtype((">" if is_big else "<") + kind)


def mm_per(unit: str) -> float:
    """Millimetres of a unit of length; what names none is in mm.

    Raises
    ------
    InvalidInputError
        If the unit is not known.
    """
    if (factor := _factor(_MM_PER, unit or "?")) is None:
        raise InvalidInputError(f"expected a unit as mm, cm, m or um, got {unit}")
    return factor


def _factor(units: Mapping[float, str], unit: str) -> float | None:
    """Factor of a unit by its name, long ones with or without a plural's s; None if it is not among them."""
    return _key(units, unit.lower() if len(unit) < 4 else unit.lower().removesuffix("s"))


def _key(table: Mapping[_Key, str], word: str) -> _Key | None:
    """Key whose text has the word; None if none has it."""
    return next((key for key, words in table.items() if word in words.split()), None)


def _placement(words: Mapping[str, Any], count: int) -> tuple[FloatArray | None, FloatArray | None]:
    """Steps along the axes and the place of the first pixel, where they are said; see `SequenceHeader`."""
    units, space = words.get("units", []), words.get("space", "").lower()  # as left-posterior-superior or LPS
    lengths = [unit for unit in units if _factor(_S_PER, unit) is None]
    scale = mm_per("".join((words.get("space units") or lengths)[:1])) * np.ones(max(count, 3))
    is_against = [space.startswith("r"), "anterior" in space or space[1:2] == "a"]
    scale[:2] *= np.where(is_against, -1.0, 1.0)
    axes, origin = words.get("space directions"), words.get("space origin")
    if (steps := words.get("spacings")) is not None:
        axes = np.diag(steps * np.array([mm_per(unit) if unit in lengths else 1.0 for unit in units] or 1.0))
    elif axes is not None:
        axes = axes * scale[: axes.shape[1]]
    return axes, None if origin is None else origin * scale[: len(origin)]


def _axis_times(words: Mapping[str, Any], axis: int, sizes: Sequence[int]) -> FloatArray | None:
    """Times of frames by the index of their axis, as 3D Slicer writes it, or by the step between them."""
    unit_s = _factor(_S_PER, "".join(words.get("units", ())[axis : axis + 1]))
    index, steps = words.get(f"axis {axis} index values", "").split(), words.get("spacings")
    if index and words.get(f"axis {axis} index type", "numeric") == "numeric":
        times = np.full(max(sizes[axis], len(index)), np.nan)
        times[: len(index)] = index
        return times[: sizes[axis]] * (unit_s or 1.0)
    step_s = 0.0 if steps is None else (unit_s or 0.0) * float(steps[axis])
    return np.asarray(step_s * np.arange(sizes[axis])) if step_s > 0 else None


def _lines(stream: BinaryIO) -> Iterator[str]:
    for line in stream:
        try:
            yield line.decode("utf-8-sig").rstrip("\r\n")
        except UnicodeDecodeError:
            yield line.decode("latin-1").rstrip("\r\n")


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
    is_nrrd, words = path.suffix == ".nrrd", _NUMBER_TYPES[dtype.str[1:]].split()
    pack = isal_zlib.compressobj(1, isal_zlib.DEFLATED, _GZIP if is_nrrd else _ZLIB) if is_packed else None
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
{_field_lines(fields, " = ")}ElementDataFile = LOCAL
"""
        if is_nrrd:
            text = f"""NRRD0004
type: {words[-1]}
dimension: {len(shape)}
sizes: {sizes}
{axes}
endian: little
encoding: {"gzip" if is_packed else "raw"}
{_field_lines(fields, ":=")}
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


def _field_lines(fields: Mapping[str, object], sign: str) -> str:
    return "".join(f"{name}{sign}{value}\n" for name, value in fields.items())
