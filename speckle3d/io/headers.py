"""Text headers of MetaImage and NRRD files, with the per-frame fields that PLUS writes into them.

References
----------
.. [1] G. Kindlmann, "Definition of NRRD File Format", teem.sourceforge.net.
.. [2] ITK, "MetaIO documentation".
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import PathLike, open_regular
from speckle3d.io.hdf5 import reading
from speckle3d.io.pixels import Pixels, map_pixels, number_type
from speckle3d.io.text import numbers

_FRAME_FIELD = re.compile(r"Seq_Frame0*(\d{1,7})_(\w+)")
_LONGEST_LINE = 2**24
_MM_PER = {
    "": 1.0, "?": 1.0, "none": 1.0, "unknown": 1.0, "mm": 1.0, "millimeter": 1.0, "millimeters": 1.0,
    "cm": 10.0, "centimeter": 10.0, "centimeters": 10.0, "m": 1e3, "meter": 1e3, "meters": 1e3, "um": 1e-3,
    "µm": 1e-3, "micrometer": 1e-3, "micrometers": 1e-3, "micron": 1e-3, "in": 25.4, "inch": 25.4,
}  # fmt: skip
_S_PER = {"s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6}
_SPACE, _TIME = ("domain", "space", "", "???", "none", "?"), ("list", "time")
_PACKINGS = {
    "raw": "raw", "gz": "deflate", "gzip": "deflate", "bz2": "bzip2", "bzip2": "bzip2",
    "txt": "text", "text": "text", "ascii": "text",
}  # fmt: skip

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
    size : tuple of int
        Lengths of the image's axes, fastest first, and the number of frames if there is an axis for them.
    spacing_mm : tuple of float, or None
        Of the first two axes; None where the header holds the pixel unit 1 that stands for "unknown".
    fields : dict
        Fields of the whole file.
    frames : tuple of dict
        Fields of each frame, without the ``Seq_FrameNNNN_`` before their names; empty for a plain image.
    pixels : Pixels
        Where they lie; there may be none, as in recordings of a tracker alone.
    stored : tuple of int
        Lengths of all axes in the file, fastest first.
    frame_axis : int, optional
        Of `stored`.
    channels : int
        Numbers a pixel.
    index_s : ndarray, shape (n,), optional
        Times of the frames by their axis.
    """

    path: str
    size: tuple[int, ...]
    spacing_mm: tuple[float, float] | None
    fields: dict[str, str]
    frames: tuple[dict[str, str], ...]
    pixels: Pixels
    stored: tuple[int, ...]
    frame_axis: int | None = 2
    channels: int = 1
    index_s: FloatArray | None = None

    @property
    def frame_count(self) -> int:
        """Frames, from the third axis; a plane image is one frame."""
        return self.size[2] if len(self.size) > 2 else 1

    @property
    def is_volume(self) -> bool:
        """Whether all three axes are of space, as they say and frames' fields do not contradict."""
        kinds = (self.fields.get("Kinds") or self.fields.get("kinds", "")).lower().split()
        is_spatial = len(kinds) == 3 and kinds[2] in ("domain", "space")
        return is_spatial and (not self.frames or self.frame_count > len(self.frames))

    @property
    def is_nrrd(self) -> bool:
        """Whether the file is NRRD, else MetaImage."""
        return "sizes" in self.fields

    @property
    def transforms(self) -> list[str]:
        """Names of the tracked transforms, as ``ProbeToTracker``."""
        names = {name for frame in self.frames for name in frame if name.endswith("Transform")}
        return sorted(name.removesuffix("Transform") for name in names)

    def images(self) -> npt.NDArray[Any]:
        """Map or unpack all images, shape (frame, y, x).

        Raises
        ------
        FileError
            If pixels are damaged or missing.
        """
        try:
            values = map_pixels(self.pixels).reshape(self.stored[::-1])
        except FileError as error:
            if self.path in str(error):
                raise
            raise FileError(f"{self.path}: expected its pixels in a file beside it: {error}") from error
        if self.frame_axis is not None:
            values = np.moveaxis(values, len(self.stored) - 1 - self.frame_axis, 0)
        return values.reshape(self.frame_count, self.size[1], self.size[0])


def is_metaimage(start: bytes) -> bool:
    """Whether a file's first bytes are those of a MetaImage header."""
    first = start.split(b"\n", 1)[0].split(b"=")[0].strip()
    return first in (b"ObjectType", b"NDims", b"Comment", b"ObjectSubType") and b"=" in start


def is_nrrd(start: bytes) -> bool:
    """Whether a file's first bytes are those of an NRRD header."""
    return start.startswith(b"NRRD000")


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
        stream.seek(0)
        if is_nrrd(start):
            return _nrrd_header(Path(path), stream)
        if is_metaimage(start):
            return _meta_header(Path(path), stream)
    raise InvalidInputError(f"{path}: expected a MetaImage or NRRD header, got something else")


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
    while line := stream.readline(_LONGEST_LINE):
        try:
            yield line.decode("utf-8").rstrip("\r\n")
        except UnicodeDecodeError:
            yield line.decode("latin-1").rstrip("\r\n")


def _meta_header(path: Path, stream: BinaryIO) -> SequenceHeader:
    lines: dict[str, str] = {}
    for line in _lines(stream):
        name, _, value = line.partition("=")
        lines[name.strip()] = value.strip()
        if name.strip() == "ElementDataFile":
            break
    else:
        raise FileError(f"{path}: expected a MetaImage header up to ElementDataFile, got a truncated one")
    stored = _sizes(path, lines, "DimSize")
    text, steps = lines.get("ElementSpacing") or lines.get("ElementSize"), None
    if text:
        factor = mm_per(lines.get("DistanceUnits", ""), f"{path}: DistanceUnits")
        steps = [factor * step for step in numbers(text, len(stored), f"{path}: ElementSpacing")]
    channels = int(lines.get("ElementNumberOfChannels", "1"))
    count, name = math.prod(stored) * channels, lines["ElementDataFile"]
    skipped = int(lines.get("HeaderSize", "0") or 0)
    source, start = path, skipped if skipped < 0 else stream.tell()
    if name.upper() != "LOCAL":
        source, start = _beside(path, name, "ElementDataFile"), skipped
    is_big = any(_is_set(lines, name) for name in ("BinaryDataByteOrderMSB", "ElementByteOrderMSB"))
    word = lines.get("ElementType", "") if count else "MET_UCHAR"  # a tracker's recording may name no type
    packing = "deflate" if _is_set(lines, "CompressedData") else "raw"
    if not _is_set(lines, "BinaryData", "True"):
        packing = "text"
    pixels = Pixels(source, start, number_type(word, is_big, f"{path}: ElementType"), count, packing)
    return _header(path, lines, stored, lines.get("Kinds", ""), steps, pixels, channels)


def _nrrd_header(path: Path, stream: BinaryIO) -> SequenceHeader:
    lines: dict[str, str] = {}
    is_whole = False
    for line in _lines(stream):
        if is_whole := not line.strip():
            break
        if line.startswith(("#", "NRRD")):
            continue
        if ":=" in line:
            name, _, value = line.partition(":=")
            lines[NRRD_NAMES.get(name.strip(), name.strip())] = value.strip()
        else:
            # Fields of the format itself, unlike those of its users, may be in letters of any size.
            name, _, value = line.partition(":")
            lines[name.strip().lower()] = value.strip()
    data = lines.get("data file", lines.get("datafile"))
    if not (is_whole or data is not None):
        raise FileError(f"{path}: expected an NRRD header up to an empty line, got a truncated one")
    stored = _sizes(path, lines, "sizes")
    dtype = number_type(lines.get("type", ""), lines.get("endian", "").lower() == "big", f"{path}: type")
    packing = lines.get("encoding", "").lower()
    if packing not in _PACKINGS:
        raise InvalidInputError(f"{path}: encoding: expected raw, gzip, bzip2 or text, got {packing!r}")
    source, start = (path, stream.tell()) if data is None else (_beside(path, data, "data file"), 0)
    lines_skipped, skipped = (
        int(lines.get(f"{what} skip", lines.get(f"{what}skip", "0"))) for what in ("line", "byte")
    )
    pixels = Pixels(
        source,
        -1 if skipped < 0 else start + skipped,
        dtype,
        math.prod(stored),
        _PACKINGS[packing],
        lines_skipped,
    )
    axes = nrrd_axes_mm(path, lines, len(stored))
    steps = None if axes is None else np.linalg.norm(axes, axis=1).tolist()
    return _header(path, lines, stored, lines.get("kinds", ""), steps, pixels)


def _is_set(lines: dict[str, str], name: str, default: str = "False") -> bool:
    return lines.get(name, default)[:1] in ("T", "t", "1")


def _header(
    path: Path,
    lines: dict[str, str],
    stored: tuple[int, ...],
    kinds_text: str,
    steps: list[float] | None,
    pixels: Pixels,
    channels: int = 1,
) -> SequenceHeader:
    """Tell axes of the image, of frames and of colours by their kinds; without, as PLUS orders them."""
    kinds = kinds_text.lower().split()
    if len(kinds) != len(stored):
        kinds = ["domain"] * len(stored)
    spatial = [i for i, kind in enumerate(kinds) if kind in _SPACE]
    frame_axis = next((i for i, kind in enumerate(kinds) if kind in _TIME), None)
    for i in {*range(len(stored))} - {*spatial, frame_axis}:
        channels *= stored[i]
    if frame_axis is None and len(spatial) == 3:
        frame_axis = spatial.pop()
    if len(spatial) == 3:  # images of 3D Slicer are a pixel thick
        thin = next((i for i in reversed(spatial) if stored[i] == 1), None)
        spatial = [i for i in spatial if i != thin]
    if len(spatial) != 2:
        raise InvalidInputError(
            f"{path}: sizes: expected images on two axes and at most one of frames, got lengths "
            f"{' '.join(map(str, stored))} of kinds {' '.join(kinds)}"
        )
    spacing = None if steps is None else (steps[spatial[0]], steps[spatial[1]])
    if spacing is not None and (not all(map(math.isfinite, spacing)) or spacing == (1.0, 1.0)):
        spacing = None  # PLUS and ITK write 1 where nobody told them
    size = tuple(stored[i] for i in (*spatial, *(() if frame_axis is None else (frame_axis,))))
    fields, frames = _split(lines)
    if frame_axis is not None and len(frames) == stored[frame_axis] + 1 and not frames[0]:
        frames = frames[1:]  # of a writer that counts from 1
    if frame_axis is not None and frame_axis == len(stored) - 1:
        pixels = replace(pixels, frames=max(stored[frame_axis], 1))
    times = None if frame_axis is None else _nrrd_times(lines, frame_axis, stored)
    return SequenceHeader(
        str(path), size, spacing, fields, frames, pixels, stored, frame_axis, channels, times
    )


def nrrd_axes_mm(path: PathLike, lines: dict[str, str], count: int) -> FloatArray | None:
    """Step along each axis of an NRRD file, shape (axis, coordinate of space); NaN of an axis that has none.

    Raises
    ------
    InvalidInputError
        If there is another number of them than of axes, or a unit is not known.
    """
    if "spacings" in lines:
        steps = [float(word) for word in lines["spacings"].split()]
        for i, unit in enumerate(_quoted(lines.get("units", ""))[: len(steps)]):
            steps[i] *= 1.0 if unit in _S_PER else mm_per(unit, f"{path}: units")
        axes = np.diag(steps)
    elif "space directions" in lines:
        rows = re.findall(r"\(([^)]*)\)|none", lines["space directions"].lower())
        vectors = [
            numbers(row.replace(",", " "), None, f"{path}: space directions") if row else () for row in rows
        ]
        units = _quoted(lines.get("space units", lines.get("units", "")))
        factor = mm_per(next((unit for unit in units if unit not in _S_PER), ""), f"{path}: space units")
        width = max(map(len, vectors), default=0)
        axes = np.full((len(rows), width), np.nan)
        for axis, vector in zip(axes, vectors, strict=True):
            if vector:
                axis[:] = np.multiply(vector, factor)
    else:
        return None
    if len(axes) != count:
        raise InvalidInputError(f"{path}: expected a spacing for each of {count} axes, got {len(axes)}")
    return axes


def _nrrd_times(lines: dict[str, str], axis: int, stored: tuple[int, ...]) -> FloatArray | None:
    """Times of frames by their axis: its index, as 3D Slicer writes it, or its spacing in a unit of time."""
    units = _quoted(lines.get("units", ""))
    unit = units[axis] if len(units) == len(stored) else ""
    values = lines.get(f"axis {axis} index values", "").split()
    steps = lines.get("spacings", "").split()
    if lines.get(f"axis {axis} index type", "numeric") == "numeric" and len(values) == stored[axis]:
        return np.array(values, dtype=float) * _S_PER.get(unit, 1.0)
    if unit in _S_PER and len(steps) == len(stored) and float(steps[axis]) > 0:
        return np.arange(float(stored[axis])) * float(steps[axis]) * _S_PER[unit]
    return None


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


def _sizes(path: Path, lines: dict[str, str], name: str) -> tuple[int, ...]:
    sizes = numbers(lines.get(name, ""), None, f"{path}: {name}")
    if any(length != int(length) or not 0 <= length < 2**40 for length in sizes):
        raise InvalidInputError(f"{path}: {name}: expected whole numbers from 0, got {lines[name]}")
    return tuple(map(int, sizes))


def _beside(path: Path, name: str, field: str) -> Path:
    """Path of a data file, which lies in the header's folder: a stranger's header names no other."""
    if name.split()[:1] == ["LIST"] or ("%" in name and len(name.split()) > 1):
        raise InvalidInputError(
            f"{path}: {field}: expected LOCAL or the name of one file, got a list of files ({name!r}), which "
            "is not read: write the images into one file"
        )
    folder = path.parent.resolve()
    data = (folder / name).resolve()
    if not name or Path(name).is_absolute() or not data.is_relative_to(folder):
        raise InvalidInputError(f"{path}: {field}: expected a file in the header's own folder, got {name!r}")
    return data
