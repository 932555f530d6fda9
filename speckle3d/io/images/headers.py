"""Headers of MetaImage and NRRD files: axes, frames, pixels.

Pixels are read here: pynrrd reads all of a raw sequence into memory and stops at the first member of packed
pixels.
"""

from __future__ import annotations

import bz2
import math
import zlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.arrays import AnyArray, FloatArray
from speckle3d.core.errors import FileError, InvalidInputError, naming
from speckle3d.core.files import PathLike, open_regular
from speckle3d.io.hdf5 import reading
from speckle3d.io.images.header_fields import (
    frame_fields,
    is_image,
    meta_fields,
    mm_per,
    nrrd_fields,
    number_type,
    s_per,
)
from speckle3d.io.text import numbers

DEFLATE: Any = zlib
try:
    from isal import isal_zlib

    DEFLATE = isal_zlib
except ImportError:
    pass

ZLIB, GZIP, _EITHER = 15, 31, 47
"""Windows of deflate, and by them what is around it; either is told when unpacking."""

_ENCODINGS = {"ra": "raw", "gz": "deflate", "bz": "bzip2", "tx": "text", "te": "text", "as": "text"}
"""By how NRRD's words for them begin, as bzip2 or bz2."""
_SPACE, _TIME = ("domain", "space", "", "???", "none", "?"), ("list", "time")


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
    size : tuple of int
        Lengths of the image's axes, fastest first, and the number of frames if there is an axis for them.
    spacing_mm : tuple of float, or None
        Of the first two axes; None where the header holds the pixel unit 1 that stands for "unknown".
    file_size : tuple of int
        Lengths of all axes in the file, fastest first.
    frame_axis : int, optional
        Of `file_size`.
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
        Of the file that holds the pixels: the header's own, or one in its folder.
    start : int
        First byte of the pixels; -1 where they are last.
    encoding : str
        ``"raw"``, ``"deflate"``, ``"bzip2"`` or ``"text"``.
    """

    path: str
    container: str
    fields: dict[str, str]
    frames: dict[int, dict[str, str]]
    size: tuple[int, ...]
    spacing_mm: tuple[float, ...] | None
    file_size: tuple[int, ...]
    frame_axis: int | None
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
    def has_images(self) -> bool:
        """Whether images have more than a line; a tracker's recording has none, or a pixel a frame."""
        return 0 not in self.size and max(self.size[:2]) > 1

    @property
    def frame_count(self) -> int:
        """Frames, from the third axis, and of a tracker's recording at least those with fields."""
        count = (*self.size, 1)[2]
        return count if self.has_images else max(count, len(self.frames))

    def column(self, name: str) -> Iterator[tuple[int, str]]:
        """Number and text of each frame that has a field of this name."""
        rows = self.frames.items()
        return ((i, frame[name]) for i, frame in rows if i < self.frame_count and name in frame)

    def values(self, name: str, count: int) -> FloatArray:
        """Numbers of a field of each frame, shape (n, count); NaN where there are none that make sense."""
        values = np.full((self.frame_count, count), np.nan)
        for i, text in self.column(name):
            with suppress(InvalidInputError):
                values[i] = numbers(text, count, name)
        return values

    def images(self) -> AnyArray:
        """Map or unpack all images, shape (frame, y, x).

        Raises
        ------
        FileError
            If pixels are damaged or missing.
        """
        values = self.numbers().reshape(self.file_size[::-1])
        if self.frame_axis is not None:
            values = np.moveaxis(values, len(self.file_size) - 1 - self.frame_axis, 0)
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
        with reading(self.path), open_regular(self.data) as stream:
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
    plain = bytearray()
    while content:
        stream = bz2.BZ2Decompressor() if encoding == "bzip2" else DEFLATE.decompressobj(_EITHER)
        plain += stream.decompress(content)
        content = stream.unused_data if stream.unused_data[:2] == b"\x1f\x8b" else b""
    return bytes(plain)


def read_header(path: PathLike) -> SequenceHeader:
    """Read the text header of a MetaImage or NRRD file.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If it is neither, the header does not make sense, or its pixels lie outside its folder.
    """
    with reading(path), open_regular(path) as stream, naming(str(path)):
        start = stream.peek()
        if not is_image(start):
            raise InvalidInputError("expected a MetaImage or NRRD header, got something else")
        is_nrrd = start.startswith(b"NRRD")
        return _header(Path(path), (nrrd_fields if is_nrrd else meta_fields)(stream), is_nrrd, stream.tell())


def _header(path: Path, words: dict[str, Any], is_nrrd: bool, start: int) -> SequenceHeader:
    """Assign axes to image, frames and colours by their kinds; without kinds, as PLUS orders them."""
    sizes = tuple(map(int, words["sizes"]))
    kinds = [kind.lower() for kind in words.get("kinds", ())]
    kinds = kinds if len(kinds) == len(sizes) else [""] * len(sizes)
    sides = [i for i, kind in enumerate(kinds) if kind in _SPACE]
    frame_axis = next((i for i, kind in enumerate(kinds) if kind in _TIME), None)
    colours = {*range(len(sizes))} - {*sides, frame_axis}
    if frame_axis is None and len(sides) > 2:
        frame_axis = sides.pop()
    if len(sides) == 3:  # images of 3D Slicer are a pixel thick
        thin = next((i for i in reversed(sides) if sizes[i] == 1), None)
        sides = [i for i in sides if i != thin]
    if len(sides) != 2 or min(sizes) < 0:
        raise InvalidInputError(
            "sizes: expected images on two axes and at most one of frames, not volumes in a row or segments "
            f"in layers, got lengths {' '.join(map(str, sizes))} of kinds {' '.join(kinds)}"
        )
    size = tuple(sizes[i] for i in (*sides, frame_axis) if i is not None)
    axes, origin = _placement(words, len(sizes))
    spacing = None if axes is None else (*np.linalg.norm(axes, axis=1)[sides].tolist(),)
    if spacing is not None and (not all(0 < step < math.inf for step in spacing) or spacing == (1.0, 1.0)):
        spacing = None  # PLUS and ITK write 1 where nobody told them
    fields, frames = frame_fields(words)
    if 0 not in frames and (*size, 1)[2] in frames:  # of a writer that counts from 1
        frames = {number - 1: frame for number, frame in frames.items()}
    type_word = words["type"] if 0 not in sizes else "uchar"  # a tracker's may name no type
    encoding = _ENCODINGS.get(words["encoding"].lower()[:2])
    if encoding is None:
        raise InvalidInputError(f"encoding: expected raw, gzip, bzip2 or text, got {words['encoding']!r}")
    file, byte_skip = words.get("data file", ""), words.get("byte skip", 0)
    data, start = (_data_file(path, file), 0) if file else (path, start)
    if lines := words.get("line skip", 0):
        with open_regular(data) as stream:
            stream.seek(start)
            start += sum(len(stream.readline()) for _ in range(lines))
    return SequenceHeader(
        str(path), "NrrdImage" if is_nrrd else "MetaImage", fields, frames, size, spacing, sizes, frame_axis,
        len(sizes) == 3 and {*kinds} <= {"domain", "space"} and len(frames) < size[2],
        math.prod(sizes[i] for i in colours if i is not None) * words.get("channels", 1),
        None if frame_axis is None else _axis_times(words, frame_axis, sizes[frame_axis]), axes, origin,
        number_type(type_word, words.get("endian", "").lower() == "big"), data,
        -1 if byte_skip < 0 else start + byte_skip, encoding,
    )  # fmt: skip


def _placement(words: Mapping[str, Any], count: int) -> tuple[FloatArray | None, FloatArray | None]:
    """Steps along the axes and the place of the first pixel, where they are said; see `SequenceHeader`."""
    units = words.get("units", [])
    space_units = words.get("space units") or [unit for unit in units if s_per(unit) is None]
    space = words.get("space", "").lower()  # as left-posterior-superior or LPS
    is_against = [space.startswith("r"), "anterior" in space or space[1:2] == "a"]
    scale: FloatArray = mm_per("".join(space_units[:1])) * np.ones(max(count, 3))
    scale[:2] *= np.where(is_against, -1.0, 1.0)
    axes, origin = words.get("space directions"), words.get("space origin")
    if (steps := words.get("spacings")) is not None:
        axes = np.diag(
            steps * np.array([mm_per(unit) if s_per(unit) is None else 1.0 for unit in units] or 1.0)
        )
    elif axes is not None:
        axes = axes * scale[: axes.shape[1]]
    if origin is not None:
        origin = origin * scale[: len(origin)]
    return axes, origin


def _axis_times(words: Mapping[str, Any], axis: int, count: int) -> FloatArray | None:
    """Times of frames by the index of their axis, as 3D Slicer writes it, or by the step between them."""
    unit_s = s_per("".join(words.get("units", ())[axis : axis + 1]))
    index, steps = words.get(f"axis {axis} index values", "").split(), words.get("spacings")
    if words.get(f"axis {axis} index type", "numeric") == "numeric" and index:
        times = np.array(index, dtype=float) * (unit_s or 1.0)
        return np.append(times, np.full(count, np.nan))[:count]
    step_s = 0.0 if steps is None else (unit_s or 0.0) * float(steps[axis])
    return np.asarray(step_s * np.arange(count)) if step_s > 0 else None


def _data_file(path: Path, name: str) -> Path:
    """Path of a data file, which lies in the header's folder: a stranger's header names no other."""
    folder, words = path.parent.resolve(), name.split()
    data = (folder / name).resolve()
    if words[0] == "LIST" or ("%" in name and len(words) > 1) or not data.is_relative_to(folder):
        raise InvalidInputError(f"expected pixels in one file in the header's own folder, got {name!r}")
    return data
