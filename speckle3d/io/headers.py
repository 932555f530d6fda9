"""MetaImage and NRRD files: headers, with the per-frame fields that PLUS writes into them, and pixels.

They are read here and not by pynrrd, which reads all of a raw sequence into memory, drops letters beyond
ASCII (names of segments, micrometres) and stops at the first member of packed pixels; nor by SimpleITK,
for which frames have no fields.

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
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import PathLike, open_regular
from speckle3d.io.hdf5 import reading
from speckle3d.io.text import numbers

_library: Any = zlib
try:
    from isal import isal_zlib

    _library = isal_zlib
except ImportError:
    pass

ZLIB, GZIP, EITHER = 15, 31, 47
"""Windows of deflate, and by them what is around it; either is told when unpacking."""


def packer(window: int) -> Any:
    """Packer of level 1: at higher levels speckle hardly shrinks further, and takes several times as long."""
    return _library.compressobj(1, zlib.DEFLATED, window)


_FRAME_FIELD = re.compile(r"Seq_Frame0*(\d{1,7})_(\w+)")
_MM_PER = {
    "": 1.0, "?": 1.0, "none": 1.0, "unknown": 1.0, "mm": 1.0, "millimeter": 1.0, "millimeters": 1.0,
    "cm": 10.0, "centimeter": 10.0, "centimeters": 10.0, "m": 1e3, "meter": 1e3, "meters": 1e3, "um": 1e-3,
    "µm": 1e-3, "micrometer": 1e-3, "micrometers": 1e-3, "micron": 1e-3, "in": 25.4, "inch": 25.4,
}  # fmt: skip
_S_PER = {"s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6}
_SPACE, _TIME = ("domain", "space", "", "???", "none", "?"), ("list", "time")
_PACKINGS = {"raw": "raw", "gz": "deflate", "bz": "bzip2", "tx": "text", "te": "text", "as": "text"}
"""By how NRRD's words for them begin, as bzip2 or bz2."""
_TYPES = {
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

_SIZE_FIELD, _SIZE_PLACE = "CompressedDataSize = ", 20
"""Characters kept in a MetaImage's header for the size of the packed pixels, which is known after them."""


@dataclass(frozen=True)
class SequenceHeader:
    """What the header of an image file says.

    Attributes
    ----------
    fields : dict
        Fields of the whole file.
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
    are_spatial : bool
        Whether the header says that all axes are of space.
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
    fields: dict[str, str]
    frames: tuple[dict[str, str], ...]
    size: tuple[int, ...]
    spacing_mm: tuple[float, ...] | None
    stored: tuple[int, ...]
    frame_axis: int | None
    are_spatial: bool
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

    @property
    def is_volume(self) -> bool:
        """Whether all three axes are of space, as they say and frames' fields do not contradict."""
        is_spatial = self.are_spatial and len(self.stored) == 3
        return is_spatial and (not self.frames or self.frame_count > len(self.frames))

    @property
    def is_nrrd(self) -> bool:
        """Whether the file is NRRD, else MetaImage."""
        return "sizes" in self.fields

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
        with reading(self.path, _library.error), open_regular(self.data) as stream:
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
        stream = bz2.BZ2Decompressor() if packing == "bzip2" else _library.decompressobj(EITHER)
        content += stream.decompress(packed)
        packed = stream.unused_data if stream.unused_data[:2] == b"\x1f\x8b" else b""
    return bytes(content)


def meta_type(dtype: np.dtype[Any]) -> str:
    """Word for a type of numbers behind MetaImage's MET_."""
    return _TYPES[dtype.newbyteorder("=").str[1:]].split()[0].upper()


def nrrd_type(dtype: np.dtype[Any]) -> str:
    """NRRD's word for a type of numbers."""
    return _TYPES[dtype.newbyteorder("=").str[1:]].split()[-1]


def _number_type(word: str, is_big: bool, where: str) -> np.dtype[Any]:
    """Type of numbers by a word of either format, as ``MET_UCHAR`` or ``unsigned char``."""
    plain = word.lower().removeprefix("met_").removesuffix("_t").replace("unsigned ", "u")
    plain = plain.replace("signed ", "").removesuffix(" int").replace(" ", "")
    for kind, words in _TYPES.items():
        if plain in words.split():
            return np.dtype((">" if is_big else "<") + kind)
    raise InvalidInputError(f"{where}: expected a type of numbers as uint8 or MET_UCHAR, got {word!r}")


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
    with reading(path), open_regular(path) as stream:
        start = stream.read(512)
        if not is_image(start):
            raise InvalidInputError(f"{path}: expected a MetaImage or NRRD header, got something else")
        stream.seek(0)
        is_nrrd = start.startswith(b"NRRD")
        fields = (_nrrd_fields if is_nrrd else _meta_fields)(path, stream)
        return _header(Path(path), fields, is_nrrd, stream.tell())


def mm_per(unit: str, where: str) -> float:
    """Millimetres of a unit of length; what names none is in mm.

    Raises
    ------
    InvalidInputError
        If the unit is not known.
    """
    if unit.lower() not in _MM_PER:
        raise InvalidInputError(f"{where}: expected a unit as mm, cm, m or um, got {unit}")
    return _MM_PER[unit.lower()]


def _lines(stream: BinaryIO) -> Iterator[str]:
    for line in stream:
        try:
            yield line.decode("utf-8").rstrip("\r\n")
        except UnicodeDecodeError:
            yield line.decode("latin-1").rstrip("\r\n")


def _meta_fields(path: PathLike, stream: BinaryIO) -> dict[str, str]:
    fields: dict[str, str] = {}
    for line in _lines(stream):
        name, _, value = line.partition("=")
        fields[name.strip()] = value.strip()
        if name.strip() == "ElementDataFile":
            return fields
    raise FileError(f"{path}: expected a MetaImage header up to ElementDataFile, got a truncated one")


def _nrrd_fields(path: PathLike, stream: BinaryIO) -> dict[str, str]:
    fields: dict[str, str] = {}
    for line in _lines(stream):
        if not line.strip():
            return fields
        if line.startswith(("#", "NRRD")):
            continue
        name, sign, value = line.partition(":=")
        if sign:
            fields[NRRD_NAMES.get(name.strip(), name.strip())] = value.strip()
        else:
            # Fields of the format itself, unlike those of its users, may be in letters of any size.
            name, _, value = line.partition(":")
            fields[name.strip().lower().replace("datafile", "data file")] = value.strip()
    if "data file" not in fields:
        raise FileError(f"{path}: expected an NRRD header up to an empty line, got a truncated one")
    return fields


def _header(path: Path, fields: dict[str, str], is_nrrd: bool, start: int) -> SequenceHeader:
    """Tell axes of the image, of frames and of colours by their kinds; without, as PLUS orders them."""

    def said(name: str, *meta_names: str) -> str:
        """What a field of NRRD says, or the first of MetaImage's."""
        names = [name] if is_nrrd else [other for other in meta_names if fields.get(other)]
        return fields.get(next(iter(names), ""), "")

    def is_set(*meta_names: str) -> bool:
        return said("", *meta_names)[:1] in ("T", "t", "1")

    stored = tuple(map(int, said("sizes", "DimSize").split()))
    stated = said("kinds", "Kinds").lower().split()
    kinds = stated if len(stated) == len(stored) else ["domain"] * len(stored)
    spatial = [i for i, kind in enumerate(kinds) if kind in _SPACE]
    frame_axis = next((i for i, kind in enumerate(kinds) if kind in _TIME), None)
    colours = {*range(len(stored))} - {*spatial, frame_axis}
    channels = math.prod(stored[i] for i in colours if i is not None)
    if frame_axis is None and len(spatial) == 3:
        frame_axis = spatial.pop()
    if len(spatial) == 3:  # images of 3D Slicer are a pixel thick
        thin = next((i for i in reversed(spatial) if stored[i] == 1), None)
        spatial = [i for i in spatial if i != thin]
    if len(spatial) != 2 or min(stored) < 0:
        raise InvalidInputError(
            f"{path}: sizes: expected images on two axes and at most one of frames, got lengths "
            f"{' '.join(map(str, stored))} of kinds {' '.join(kinds)}"
        )
    size = tuple(stored[i] for i in (*spatial, frame_axis) if i is not None)
    axes, origin = _placed(path, said, len(stored))
    spacing = None if axes is None else (*np.linalg.norm(axes, axis=1)[spatial].tolist(),)
    if spacing is not None and (not all(0 < step < math.inf for step in spacing) or spacing == (1.0, 1.0)):
        spacing = None  # PLUS and ITK write 1 where nobody told them
    own, frames = _split(fields)
    if len(frames) == (*size, 0)[2] + 1 and not frames[0]:
        frames = frames[1:]  # of a writer that counts from 1
    word = said("type", "ElementType") if 0 not in stored else "uchar"  # a tracker's may name no type
    is_big = said("endian").lower() == "big" or is_set("BinaryDataByteOrderMSB", "ElementByteOrderMSB")
    encoding = said("encoding").lower()
    if not is_nrrd:
        is_binary = "BinaryData" not in fields or is_set("BinaryData")
        encoding = "gzip" if is_set("CompressedData") else "raw" if is_binary else "text"
    packing = _PACKINGS.get(encoding if encoding == "raw" else encoding[:2])
    if packing is None:
        raise InvalidInputError(f"{path}: encoding: expected raw, gzip, bzip2 or text, got {encoding!r}")
    file = said("data file", "ElementDataFile")
    skipped = int(said("byte skip", "HeaderSize") or said("byteskip") or "0")
    if not is_nrrd and file.upper() == "LOCAL":
        file, skipped = "", min(skipped, 0)
    data, start = (_beside(path, file), 0) if file else (path, start)
    return SequenceHeader(
        str(path), own, frames, size, spacing, stored, frame_axis,
        kinds is stated and {*stated} <= {"domain", "space"},
        channels * int(said("", "ElementNumberOfChannels") or "1"),
        None if frame_axis is None else _frame_times(said, frame_axis, size[2]), axes, origin,
        _number_type(word, is_big, f"{path}: type"), data,
        -1 if skipped < 0 else start + skipped, packing, int(said("line skip") or said("lineskip") or "0"),
    )  # fmt: skip


def _placed(path: Path, said: Callable[..., str], count: int) -> tuple[FloatArray | None, FloatArray | None]:
    """Steps along the axes and the place of the first pixel, where they are said; see `SequenceHeader`."""
    units = _quoted(said("units")) or [said("", "DistanceUnits").lower()] * count
    steps = said("spacings", "ElementSpacing", "ElementSize").split()
    spaces = [unit for unit in _quoted(said("space units")) or units if unit not in _S_PER]
    scale: FloatArray = mm_per("".join(spaces[:1]), f"{path}: space units") * np.ones(max(count, 3))
    space = said("space").lower()
    letters = "".join(word[0] for word in space.split("-")) if "-" in space else space
    scale[:2] *= [-1.0 if letters[:1] == "r" else 1.0, -1.0 if letters[1:2] == "a" else 1.0]
    axes: FloatArray | None = None
    if steps:
        of_space = [1.0 if unit in _S_PER else mm_per(unit, f"{path}: units") for unit in units]
        axes = np.diag(np.array(steps, dtype=float) * (of_space or 1.0))
        if turn := said("", "TransformMatrix", "Rotation", "Orientation"):
            axes = axes @ np.reshape(numbers(turn, axes.size, f"{path}: TransformMatrix"), axes.shape)
    elif directions := said("space directions").lower():
        rows = re.findall(r"\(([^)]*)\)|none", directions)
        vectors = [_vector(row, f"{path}: space directions") if row else np.empty(0) for row in rows]
        axes = np.full((len(rows), max(map(len, vectors), default=0)), np.nan)
        for axis, vector in zip(axes, vectors, strict=True):
            axis[: len(vector)] = vector * scale[: len(vector)]
    if axes is not None and len(axes) != count:
        raise InvalidInputError(f"{path}: expected a spacing for each of {count} axes, got {len(axes)}")
    origin = None
    if place := said("space origin", "Offset", "Position", "Origin"):
        origin = _vector(place.strip("() "), f"{path}: space origin")
        origin *= scale[: len(origin)]
    return axes, origin


def _frame_times(said: Callable[..., str], axis: int, count: int) -> FloatArray | None:
    """Times of frames by their axis: its index, as 3D Slicer writes it, or its spacing in a unit of time."""
    units, steps = _quoted(said("units")), said("spacings").split()
    unit, index = "".join(units[axis : axis + 1]), said(f"axis {axis} index values").split()
    if said(f"axis {axis} index type") in ("", "numeric") and len(index) == count:
        return np.array(index, dtype=float) * _S_PER.get(unit, 1.0)
    if unit in _S_PER and steps and float(steps[axis]) > 0:
        return np.arange(float(count)) * float(steps[axis]) * _S_PER[unit]
    return None


def _vector(text: str, where: str) -> FloatArray:
    return np.array(numbers(text.replace(",", " "), None, where))


def _quoted(text: str) -> list[str]:
    return [word.strip().lower() for word in re.findall(r'"([^"]*)"', text)]


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
    is_list = words[:1] == ["LIST"] or ("%" in name and len(words) > 1)
    if is_list or not name or not data.is_relative_to(folder):
        raise InvalidInputError(
            f"{path}: expected pixels in one file in the header's own folder, got {name!r}"
        )
    return data


def header_bytes(lines: Iterable[str]) -> bytes:
    """Lines of a header as bytes that are read back as the same text."""
    return "".join(f"{line}\n" for line in lines).encode("utf-8", "backslashreplace")


def meta_start(packed_size: int | None) -> list[str]:
    """First lines of the header of a MetaImage of three axes.

    Parameters
    ----------
    packed_size : int or None
        Bytes of the packed pixels, 0 if `put_packed_size` tells them later; None if they are not packed.
    """
    return [
        "ObjectType = Image",
        "NDims = 3",
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
