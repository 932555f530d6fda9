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
from speckle3d.io.pixels import Pixels, map_pixels, meta_pixels, nrrd_pixels
from speckle3d.io.text import numbers

_FRAME_FIELD = re.compile(r"Seq_Frame(\d+)_(\w+)")
_MOST_LINES = 10**8
_MM_PER = {
    "": 1.0, "?": 1.0, "none": 1.0, "mm": 1.0, "millimeter": 1.0, "millimeters": 1.0, "cm": 10.0,
    "centimeter": 10.0, "centimeters": 10.0, "m": 1e3, "meter": 1e3, "meters": 1e3, "um": 1e-3, "µm": 1e-3,
    "micrometer": 1e-3, "micrometers": 1e-3, "micron": 1e-3, "in": 25.4, "inch": 25.4,
}  # fmt: skip
_S_PER = {"": 1.0, "?": 1.0, "none": 1.0, "s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3,
          "msec": 1e-3, "us": 1e-6}  # fmt: skip
_SPACE, _TIME = ("domain", "space", "", "???", "none", "?"), ("list", "time")

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
    def kinds(self) -> list[str]:
        """What the axes are, fastest first, as domain or list; none where the header does not say."""
        return (self.fields.get("Kinds") or self.fields.get("kinds", "")).lower().split()

    @property
    def is_volume(self) -> bool:
        """Whether the third axis is of space, as ``Kinds`` says and frames' fields do not contradict."""
        in_space = len(self.kinds) == 3 and self.kinds[2] in ("domain", "space")
        return in_space and self.frame_count > max(len(self.frames), 1)

    @property
    def file_format(self) -> str:
        """``"NrrdImage"`` or ``"MetaImage"``."""
        return "NrrdImage" if "sizes" in self.fields else "MetaImage"

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
        axis = 0 if self.frame_axis is None else len(self.stored) - 1 - self.frame_axis
        turned = values if self.frame_axis is None else np.moveaxis(values, axis, 0)
        return turned.reshape(self.frame_count, self.size[1], self.size[0])


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
            return _nrrd_header(Path(path), dict(_nrrd_lines(path, stream)), stream.tell())
        if is_metaimage(start):
            return _meta_header(Path(path), dict(_meta_lines(path, stream)), stream.tell())
    raise InvalidInputError(f"{path}: expected a MetaImage or NRRD header, got something else")


def _meta_lines(path: PathLike, stream: BinaryIO) -> Iterator[tuple[str, str]]:
    for line in _lines(stream):
        name, equals, value = line.partition("=")
        if not equals:
            break
        yield name.strip(), value.strip()
        if name.strip() == "ElementDataFile":
            return
    raise FileError(f"{path}: expected a MetaImage header up to ElementDataFile, got a truncated one")


def _nrrd_lines(path: PathLike, stream: BinaryIO) -> Iterator[tuple[str, str]]:
    is_apart = False
    for line in _lines(stream):
        if not line.strip():
            return
        if line.startswith(("#", "NRRD")):
            continue
        if ":=" in line:
            name, _, value = line.partition(":=")
            yield NRRD_NAMES.get(name.strip(), name.strip()), value.strip()
        else:
            # Fields of the format itself, unlike those of its users, may be in letters of any size.
            name, _, value = line.partition(":")
            name = name.strip().lower()
            is_apart = is_apart or name in ("data file", "datafile")
            yield name, value.strip()
    if not is_apart:
        raise FileError(f"{path}: expected an NRRD header up to an empty line, got a truncated one")


def _lines(stream: BinaryIO) -> Iterator[str]:
    for _ in range(_MOST_LINES):
        line = stream.readline(2**16)
        if not line:
            return
        if b"\0" in line:
            raise FileError(f"{stream.name}: expected text in the header, got a zero byte")
        try:
            text = line.decode("utf-8")
        except UnicodeDecodeError:
            text = line.decode("latin-1")
        yield text.rstrip("\r\n")


def _meta_header(path: Path, lines: dict[str, str], start: int) -> SequenceHeader:
    stored = _sizes(path, lines, "DimSize")
    text = lines.get("ElementSpacing") or lines.get("ElementSize")
    factor = _factor(path, "DistanceUnits", lines.get("DistanceUnits", ""), _MM_PER)
    steps = None
    if text:
        steps = [factor * step for step in numbers(text, len(stored), f"{path}: ElementSpacing")]
    channels = int(lines.get("ElementNumberOfChannels", "1"))
    pixels = meta_pixels(path, lines, math.prod(stored) * channels, start)
    return _header(path, lines, stored, lines.get("Kinds", ""), steps, pixels, channels)


def _nrrd_header(path: Path, lines: dict[str, str], start: int) -> SequenceHeader:
    stored = _sizes(path, lines, "sizes")
    pixels = nrrd_pixels(path, lines, math.prod(stored), start)
    return _header(path, lines, stored, lines.get("kinds", ""), _nrrd_steps(path, lines, len(stored)), pixels)


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
    known = None if steps is None else [steps[i] for i in spatial]
    size = tuple(stored[i] for i in (*spatial, *(() if frame_axis is None else (frame_axis,))))
    fields, frames = _split(lines)
    if frame_axis is not None and len(frames) == stored[frame_axis] + 1 and not frames[0]:
        frames = frames[1:]  # of a writer that counts from 1
    times = _nrrd_times(path, lines, frame_axis, stored)
    if frame_axis is not None and frame_axis == len(stored) - 1:
        pixels = replace(pixels, frames=max(stored[frame_axis], 1))
    return SequenceHeader(
        str(path), size, _spacing(known), fields, frames, pixels, stored, frame_axis, channels, times
    )


def _nrrd_steps(path: Path, lines: dict[str, str], count: int) -> list[float] | None:
    """Distance along each axis, mm; NaN of those that have none."""
    if "spacings" in lines:
        steps = [float(word) for word in lines["spacings"].split()]
        units = _quoted(lines.get("units", ""), count)
    elif "space directions" in lines:
        vectors = re.findall(r"\([^)]*\)|none", lines["space directions"].lower())
        where = f"{path}: space directions"
        steps = [
            math.nan
            if text == "none"
            else float(np.linalg.norm(numbers(re.sub("[(),]", " ", text), None, where)))
            for text in vectors
        ]
        space = _quoted(lines.get("space units", lines.get("units", "")), count)
        units = [next((unit for unit in space if unit in _MM_PER), "")] * count
    else:
        return None
    if len(steps) != count:
        raise InvalidInputError(f"{path}: expected a spacing for each of {count} axes, got {len(steps)}")
    return [
        step if unit in _S_PER and unit not in _MM_PER else step * _factor(path, "units", unit, _MM_PER)
        for step, unit in zip(steps, units, strict=True)
    ]


def _nrrd_times(
    path: Path, lines: dict[str, str], axis: int | None, stored: tuple[int, ...]
) -> FloatArray | None:
    """Times of frames by their axis: its index, as 3D Slicer writes it, or its spacing in a unit of time."""
    if axis is None:
        return None
    units = _quoted(lines.get("units", ""), len(stored))
    unit = units[axis] if axis < len(units) else ""
    values = lines.get(f"axis {axis} index values", "").split()
    if lines.get(f"axis {axis} index type", "numeric") == "numeric" and len(values) == stored[axis]:
        try:
            return np.array([float(word) for word in values]) * _factor(path, "units", unit, _S_PER)
        except ValueError:
            return None
    steps = lines.get("spacings", "").split()
    if unit in _S_PER and unit not in _MM_PER and len(steps) == len(stored) and float(steps[axis]) > 0:
        return np.arange(float(stored[axis])) * float(steps[axis]) * _S_PER[unit]
    return None


def _quoted(text: str, count: int) -> list[str]:
    words = [word.strip().lower() for word in re.findall(r'"([^"]*)"', text)]
    return words if len(words) == count else [*words, *[""] * (count - len(words))][:count]


def _factor(path: Path, field: str, unit: str, known: dict[str, float]) -> float:
    if unit.lower() not in known:
        raise InvalidInputError(
            f"{path}: {field}: expected one of {', '.join(filter(None, known))}, got {unit}"
        )
    return known[unit.lower()]


def _split(lines: dict[str, str]) -> tuple[dict[str, str], tuple[dict[str, str], ...]]:
    """Fields of the file, and of each frame; none of a frame that the header leaves out."""
    frames: dict[int, dict[str, str]] = {}
    fields = {}
    for name, value in lines.items():
        if match := _FRAME_FIELD.fullmatch(name):
            frames.setdefault(int(match[1]), {})[match[2]] = value
        else:
            fields[name] = value
    count = min(max(frames, default=-1) + 1, 10**7)
    return fields, tuple(frames.get(i, {}) for i in range(count))


def _spacing(steps: list[float] | None) -> tuple[float, float] | None:
    """Of the first two axes, but for the 1 that PLUS and ITK write where nobody told them."""
    if steps is None or not all(map(math.isfinite, steps[:2])) or steps[:2] == [1.0, 1.0]:
        return None
    return steps[0], steps[1]


def _sizes(path: Path, lines: dict[str, str], name: str) -> tuple[int, ...]:
    sizes = numbers(lines.get(name, ""), None, f"{path}: {name}")
    if any(length != int(length) or not 0 <= length < 2**40 for length in sizes):
        raise InvalidInputError(f"{path}: {name}: expected whole numbers from 0, got {lines[name]}")
    return tuple(map(int, sizes))
