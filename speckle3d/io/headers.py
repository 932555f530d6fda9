"""Text headers of MetaImage and NRRD files, with the per-frame fields that PLUS writes into them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import PathLike, open_regular
from speckle3d.io.hdf5 import reading
from speckle3d.io.pixels import Pixels, meta_pixels, nrrd_pixels
from speckle3d.io.text import numbers

_FRAME_FIELD = re.compile(r"Seq_Frame(\d+)_(\w+)")
_HEADER_LIMIT_BYTES = 2**28
"""A header of a thousand bytes for each of a quarter million frames; beyond it the file is no header."""

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
        Length of the first axes, fastest first, frames left out.
    spacing_mm : tuple of float, or None
        Of the first two axes; None where the header holds the pixel unit 1 that stands for "unknown".
    fields : dict
        Fields of the whole file.
    frames : tuple of dict
        Fields of each frame, without the ``Seq_FrameNNNN_`` before their names; empty for a plain image.
    pixels : Pixels
        Where they lie; there may be none, as in recordings of a tracker alone.
    """

    path: str
    size: tuple[int, ...]
    spacing_mm: tuple[float, float] | None
    fields: dict[str, str]
    frames: tuple[dict[str, str], ...]
    pixels: Pixels

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
        If the file cannot be read, or holds fewer bytes of pixels than its header announces.
    InvalidInputError
        If it is neither, the header does not make sense, or its pixels lie outside its folder.
    """
    with reading(path), open_regular(path) as stream:
        start = stream.read(512)
        stream.seek(0)
        if is_nrrd(start):
            return _nrrd_header(path, dict(_nrrd_lines(path, stream)), stream)
        if is_metaimage(start):
            return _meta_header(path, dict(_meta_lines(path, stream)), stream)
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
    while stream.tell() < _HEADER_LIMIT_BYTES and (line := stream.readline(2**16)):
        if b"\0" in line:
            raise FileError(f"{stream.name}: expected text in the header, got a zero byte")
        try:
            text = line.decode("utf-8")
        except UnicodeDecodeError:
            text = line.decode("latin-1")
        yield text.rstrip("\r\n")


def _meta_header(path: PathLike, lines: dict[str, str], stream: BinaryIO) -> SequenceHeader:
    size = _sizes(path, lines, "DimSize")
    spacing = lines.get("ElementSpacing") or lines.get("ElementSize")
    known = numbers(spacing, len(size), f"{path}: ElementSpacing") if spacing else None
    return _header(path, size, known, lines, meta_pixels(Path(path), lines, size, stream.tell()))


def _nrrd_header(path: PathLike, lines: dict[str, str], stream: BinaryIO) -> SequenceHeader:
    size = _sizes(path, _without_thickness(lines), "sizes")
    if "spacings" in lines:
        first_two = lines["spacings"].lower().replace("nan", "1").split()[:2]
        known: tuple[float, ...] | None = numbers(" ".join(first_two), 2, f"{path}: spacings")
    else:
        known = _direction_lengths(path, lines.get("space directions", ""))
    return _header(path, size, known, lines, nrrd_pixels(Path(path), lines, size, stream.tell()))


def _without_thickness(lines: dict[str, str]) -> dict[str, str]:
    """Sizes of a sequence of 3D Slicer, whose images are a pixel thick, as those of a sequence of planes."""
    words = lines.get("sizes", "").split()
    if lines.get("kinds", "").split()[-1:] == ["list"] and len(words) == 4 and words[2] == "1":
        return {"sizes": " ".join((words[0], words[1], words[3]))}
    return lines


def _header(
    path: PathLike,
    size: tuple[int, ...],
    spacing: tuple[float, ...] | None,
    lines: dict[str, str],
    pixels: Pixels,
) -> SequenceHeader:
    frames: dict[int, dict[str, str]] = {}
    fields = {}
    for name, value in lines.items():
        if match := _FRAME_FIELD.fullmatch(name):
            frames.setdefault(int(match[1]), {})[match[2]] = value
        else:
            fields[name] = value
    if frames and sorted(frames) != list(range(len(frames))):
        gap = next(i for i in range(len(frames)) if i not in frames)
        raise InvalidInputError(f"{path}: expected fields Seq_Frame{gap:04d}_..., got none for frame {gap}")
    # PLUS and ITK write 1 where nobody told them; no ultrasound image has millimetre samples.
    known = None if spacing is None or spacing[:2] == (1.0, 1.0) else (spacing[0], spacing[1])
    ordered = tuple(frames[i] for i in range(len(frames)))
    return SequenceHeader(str(path), size, known, fields, ordered, pixels)


def _sizes(path: PathLike, lines: dict[str, str], name: str) -> tuple[int, ...]:
    sizes = tuple(int(n) for n in numbers(lines.get(name, ""), None, f"{path}: {name}"))
    if len(sizes) not in (2, 3) or min(sizes) < 0:
        raise InvalidInputError(f"{path}: {name}: expected two or three lengths, got {lines[name]}")
    return sizes


def _direction_lengths(path: PathLike, text: str) -> tuple[float, ...] | None:
    vectors = re.findall(r"\(([^)]*)\)", text)[:2]
    if len(vectors) < 2:
        return None
    where = f"{path}: space directions"
    with np.errstate(over="ignore"):
        return tuple(float(np.linalg.norm(numbers(v.replace(",", " "), None, where))) for v in vectors)
