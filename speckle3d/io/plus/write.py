"""Writing of a sweep as a sequence of PLUS, image by image.

References
----------
.. [1] PLUS user manual, "Sequence file".
.. [2] G. Kindlmann, "Definition of NRRD File Format", teem.sourceforge.net.
.. [3] 3D Slicer developer guide, "Volume sequence file format (.seq.nrrd)".
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, Speckle3DError
from speckle3d.core.files import PathLike
from speckle3d.core.parts import cannot_write
from speckle3d.core.progress import Progress
from speckle3d.core.sweep import Sweep, stored_dtype
from speckle3d.io.fileset import FileSet
from speckle3d.io.hdf5 import atomic_path
from speckle3d.io.header_text import header_bytes, meta_start, put_packed_size
from speckle3d.io.headers import NRRD_NAMES, read_header
from speckle3d.io.pixels import meta_type, nrrd_type, type_of_word
from speckle3d.io.plus.layout import Layout
from speckle3d.io.plus.rows import Rows, number_of, rows_of, rows_without_images

SUFFIXES = (".mha", ".mhd", ".nrrd")
"""Of the files that `write_sequence` writes, as .igs.mha."""

_OF_SLICER = ".seq.nrrd"
"""With four axes, the last of them the frames, as 3D Slicer reads it [3]_; other NRRD files have three."""

_LEVEL = 1
"""Speckle hardly compresses further at higher levels, which cost several times the time."""

_ZLIB, _GZIP = 15, 31
"""Windows of deflate, and by them what is around it."""

_NRRD_NAMES = {name: nrrd for nrrd, name in NRRD_NAMES.items()}
_META_ONLY = ("NDims", "ElementType", "ElementSpacing")


def write_sequence(
    path: PathLike,
    sweep: Sweep,
    progress: Progress | None = None,
    compressed: bool = True,
    transforms: Mapping[str, FloatArray] | None = None,
) -> list[str]:
    """Write a sweep as a sequence of PLUS, of the container that the suffix names; memory stays flat.

    A sweep that was read from a sequence gets all of its fields back: transforms, status, times and custom
    fields of every frame, also of those without a valid image, which are written as black. Of others, a
    tracker becomes ``ProbeToTrackerTransform`` and an orientation sensor
    ``OrientationSensorToWorldTransform``, interpolated at the frames' times, with status INVALID where
    readings do not reach.

    Parameters
    ----------
    path : path
        With a suffix of `SUFFIXES`; pixels of .mhd go to a .raw or .zraw file beside it.
    progress : callable, optional
        Called with the number of images written and their total.
    compressed : bool
        Whether pixels are packed with deflate.
    transforms : mapping of str to ndarray, shape (n, 4, 4), optional
        More transforms of the sweep's frames, by names as ``ImageToWorld``: of pixels to mm.

    Returns
    -------
    list of str
        What of the sweep a sequence does not hold, a line each.

    Raises
    ------
    InvalidInputError
        If the suffix is another.
    FileError
        If the file cannot be written.
    """
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix not in SUFFIXES:
        raise InvalidInputError(f"{path}: expected a name ending in {', '.join(SUFFIXES)}, got {suffix!r}")
    rows = rows_of(sweep)
    for name, matrices in (transforms or {}).items():
        rows.add_transforms(name, matrices)
    images = _Images.of(sweep, rows, progress)
    if suffix == ".mhd":
        _write_two_files(target, images, rows, compressed)
    elif suffix == ".nrrd":
        is_slicers = target.name.lower().endswith(_OF_SLICER)
        with atomic_path(target) as part, part.open("wb") as file:
            file.write(_nrrd_header(images, rows, "gzip" if compressed else "raw", is_slicers))
            images.write(file, _GZIP if compressed else None)
    else:
        head = _meta_header(images, rows, "LOCAL", 0 if compressed else None)
        with atomic_path(target) as part, part.open("wb") as file:
            file.write(head)
            size = images.write(file, _ZLIB if compressed else None)
            if compressed:
                put_packed_size(file, head, size)
    return rows.left_out


def write_transforms(path: PathLike, times_s: FloatArray, transforms: Mapping[str, FloatArray]) -> None:
    """Write a sequence of transforms without images; the file appears whole or not at all.

    Parameters
    ----------
    path : path
        With the suffix .mha.
    times_s : ndarray, shape (n,)
    transforms : mapping of str to ndarray, shape (n, 4, 4)
        By names as ``ImageToWorld``.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    rows = rows_without_images(times_s)
    for name, matrices in transforms.items():
        rows.add_transforms(name, matrices)
    lines = [
        *meta_start(3, None),
        f"DimSize = 0 0 {len(times_s)}",
        "Kinds = domain domain list",
        "ElementSpacing = 1 1 1",
        "ElementType = MET_UCHAR",
        *_frame_lines(rows, " = "),
        "ElementDataFile = LOCAL",
    ]
    with atomic_path(path) as part:
        part.write_bytes(header_bytes(lines))


def _write_two_files(target: Path, images: _Images, rows: Rows, compressed: bool) -> None:
    """Write a MetaImage's header, and its pixels into a file beside it; both appear, or neither."""
    beside = f"{target.stem}.{'zraw' if compressed else 'raw'}"
    _require_own(target, target.with_name(beside))
    with FileSet(target.name, (beside,), _left_by(target, beside)).replaced(target.parent) as part:
        try:
            with (part / beside).open("wb") as file:
                size = images.write(file, _ZLIB if compressed else None)
            header = _meta_header(images, rows, beside, size if compressed else None)
            (part / target.name).write_bytes(header)
        except Speckle3DError:
            raise
        except OSError as error:
            raise cannot_write(target, error) from error


def _require_own(header: Path, data: Path) -> None:
    """Refuse to write over pixels that are not those of the header that is replaced."""
    if not data.exists():
        return
    if not header.exists() or read_header(header).pixels.path != data.resolve():
        raise InvalidInputError(f"{data}: is there and no part of {header.name}: give another name")


def _left_by(header: Path, beside: str) -> tuple[str, ...]:
    """Name of the pixels that a header leaves behind which is replaced by one with other pixels."""
    if not header.exists():
        return ()
    names = {f"{header.stem}.{suffix}" for suffix in ("raw", "zraw")} - {beside}
    return tuple(names & {read_header(header).pixels.path.name})


@dataclass(frozen=True)
class _Images:
    """Pixels to write."""

    sweep: Sweep
    rows: Rows
    layout: Layout
    dtype: np.dtype[Any]
    shape: tuple[int, int]
    progress: Progress | None

    @classmethod
    def of(cls, sweep: Sweep, rows: Rows, progress: Progress | None) -> _Images:
        layout = Layout(rows.fields["UltrasoundImageType"], rows.fields["UltrasoundImageOrientation"])
        dtype = _narrowest(sweep, rows)
        word = rows.fields.get("ElementType", "")
        if word and np.can_cast(dtype, type_of_word(word), "safe"):
            dtype = type_of_word(word)
        shape = layout.pixels(sweep.frames[0]).shape
        return cls(sweep, rows, layout, dtype, (shape[0], shape[1]), progress)

    def __iter__(self) -> Iterator[npt.NDArray[Any]]:
        written = 0
        for number in self.rows.images:
            if number is None:
                yield np.zeros(self.shape, self.dtype)
                continue
            yield self.layout.pixels(self.rows.stored(self.sweep.frames[number]))
            written += 1
            if self.progress is not None:
                self.progress(written, len(self.sweep))

    def write(self, file: BinaryIO, window: int | None) -> int:
        """Write all images, packed if there is a window, and return how many bytes that took."""
        packer = None if window is None else _packer(window)
        size = 0
        for image in self:
            raw = image.astype(self.dtype.newbyteorder("<"), order="C").data.cast("B")
            size += file.write(raw if packer is None else packer.compress(raw))
        return size if packer is None else size + file.write(packer.flush())


def _packer(window: int) -> Any:
    """Return ISA-L's packer, or zlib's where that has no wheel."""
    try:
        from isal import isal_zlib
    except ImportError:
        return zlib.compressobj(_LEVEL, zlib.DEFLATED, window)
    return isal_zlib.compressobj(_LEVEL, zlib.DEFLATED, window)


def _narrowest(sweep: Sweep, rows: Rows) -> np.dtype[Any]:
    """Type that holds all samples; of I and Q, int16 if all are whole numbers within it."""
    if sweep.frames.dtype.kind != "c":
        return sweep.frames.dtype
    if stored_dtype(sweep.frames) == np.int16 and not rows.conjugated:
        return np.dtype(np.int16)
    limit = np.iinfo(np.int16)
    for i in range(len(sweep)):
        parts = np.ascontiguousarray(rows.stored(sweep.frames[i])).view(np.float32)
        if parts.min() < limit.min or parts.max() > limit.max or (parts != np.rint(parts)).any():
            return np.dtype(np.float32)
    return np.dtype(np.int16)


def _lengths(images: _Images, rows: Rows) -> str:
    y, x = images.shape
    return f"{x} {y}" if rows.is_plane else f"{x} {y} {len(rows.images)}"


def _frame_lines(rows: Rows, sign: str) -> Iterator[str]:
    for i, frame in enumerate(rows.frames):
        yield from (f"Seq_Frame{i:04d}_{name}{sign}{value}" for name, value in frame.items())


def _meta_header(images: _Images, rows: Rows, data: str, packed: int | None) -> bytes:
    fields = dict(rows.fields)
    fields.pop("NDims", None)
    spacing = fields.pop("ElementSpacing")
    fields.pop("ElementType", None)
    lines = [
        *meta_start(2 if rows.is_plane else 3, packed),
        f"DimSize = {_lengths(images, rows)}",
        f"Kinds = {'domain domain' if rows.is_plane else 'domain domain list'}",
        f"ElementSpacing = {spacing}",
        f"ElementType = MET_{meta_type(images.dtype)}",
        *(f"{name} = {value}" for name, value in fields.items()),
        *_frame_lines(rows, " = "),
        f"ElementDataFile = {data}",
    ]
    return header_bytes(lines)


def _nrrd_header(images: _Images, rows: Rows, encoding: str, is_slicers: bool) -> bytes:
    lines = [
        "NRRD0004",
        f"type: {nrrd_type(images.dtype)}",
        *(_slicers_axes if is_slicers else _axes)(images, rows),
        "endian: little",
        f"encoding: {encoding}",
        *(
            f"{_NRRD_NAMES.get(name, name)}:={value}"
            for name, value in rows.fields.items()
            if name not in _META_ONLY
        ),
        *_frame_lines(rows, ":="),
        # Slicer reads the transforms up to the first line of more than 1,000 characters.
        *(_slicers_index(rows) if is_slicers else ()),
        "",
    ]
    return header_bytes(lines)


def _axes(images: _Images, rows: Rows) -> Iterator[str]:
    """Axes of an image, and one of frames, in a plane: as PLUS writes them."""
    x, y, *_ = rows.fields["ElementSpacing"].split()
    apart = "" if rows.is_plane else " none"
    yield f"dimension: {2 if rows.is_plane else 3}"
    yield "space dimension: 2"
    yield f"sizes: {_lengths(images, rows)}"
    yield f"space directions: ({x},0) (0,{y}){apart}"
    yield f"kinds: {'domain domain' if rows.is_plane else 'domain domain list'}"
    yield f"space origin: ({','.join(rows.fields.get('Offset', '0 0').split()[:2])})"


def _slicers_axes(images: _Images, rows: Rows) -> Iterator[str]:
    """Axes of images one pixel thick in space, and one of frames; transforms count pixels from its origin."""
    y, x = images.shape
    sx, sy, *_ = rows.fields["ElementSpacing"].split()
    yield "dimension: 4"
    yield "space: right-anterior-superior"
    yield f"sizes: {x} {y} 1 {len(rows.images)}"
    yield f"space directions: ({sx},0,0) (0,{sy},0) (0,0,1) none"
    yield "kinds: domain domain domain list"
    yield 'labels: "" "" "" "time"'
    yield 'units: "" "" "" "s"'
    yield "space origin: (0,0,0)"


def _slicers_index(rows: Rows) -> Iterator[str]:
    """Frames' times, by which Slicer finds what belongs together; it rounds those of transforms to 1 ms."""
    yield "DataNodeClassName:=vtkMRMLScalarVolumeNode"
    times = [f"{number_of(frame.get('Timestamp')):.3f}" for frame in rows.frames]
    values = times if len({*times}) == len(times) and "nan" not in times else map(str, range(len(times)))
    told = " ".join(values)
    # Up to version 5.6 Slicer knew the axis of frames as the first.
    for axis in (3, 0):
        yield f"axis {axis} index type:=numeric"
        yield f"axis {axis} index values:={told}"
