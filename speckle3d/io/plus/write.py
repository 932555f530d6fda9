"""Writing of a sweep as a sequence of PLUS, image by image.

References
----------
.. [1] PLUS user manual, "Sequence file".
.. [2] G. Kindlmann, "Definition of NRRD File Format", teem.sourceforge.net.
.. [3] 3D Slicer developer guide, "Volume sequence file format (.seq.nrrd)".
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError, Speckle3DError
from speckle3d.core.files import PathLike
from speckle3d.core.parts import cannot_write
from speckle3d.core.progress import Progress
from speckle3d.core.sweep import OrientationSensor, RFSettings, Sweep, Tracker, stored_dtype
from speckle3d.io.fileset import FileSet
from speckle3d.io.hdf5 import atomic_path
from speckle3d.io.header_text import header_bytes, meta_start, put_packed_size
from speckle3d.io.headers import NRRD_NAMES, read_header
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.pixels import meta_type, nrrd_type
from speckle3d.io.plus.layout import Layout
from speckle3d.io.plus.transforms import IMAGE, ORIENTATION, image_matrix
from speckle3d.io.text import numbers

SUFFIXES = (".mha", ".mhd", ".nrrd")
"""Of the files that `write_sequence` writes, as .igs.mha."""

_OF_SLICER = ".seq.nrrd"
"""With four axes, the last of them the frames, as 3D Slicer reads it [3]_; other NRRD files have three."""

_LEVEL = 1
"""Speckle hardly compresses further at higher levels, which cost several times the time."""

_ZLIB, _GZIP = 15, 31
"""Windows of deflate, and by them what is around it."""

_NRRD_NAMES = {name: nrrd for nrrd, name in NRRD_NAMES.items()}

_PREFIX = "Speckle3D_"
"""Of this package's own fields, so that reading a sequence back asks for nothing."""


def own_values(path: str, fields: Mapping[str, str]) -> dict[str, Any]:
    """Read the values that this package wrote; by name, without the prefix.

    Raises
    ------
    InvalidInputError
        Naming the field that does not make sense.
    """
    own: dict[str, Any] = {}
    for key, text in fields.items():
        name = key.removeprefix(_PREFIX)
        if name == key or name not in (*ImportSettings.model_fields, "full_scale"):
            continue
        if name == "probe":
            own[name] = text
        else:
            count = 2 if name == "bandwidth_hz" else 1
            values = numbers(text, count, f"{path}: {key}")
            own[name] = values if count == 2 else values[0]
    return own


@dataclass(frozen=True)
class _Rows:
    """Fields of the header to be written: of the whole file, and of each frame."""

    fields: dict[str, str]
    frames: list[dict[str, str]]

    @classmethod
    def of_times(cls, times_s: FloatArray) -> _Rows:
        return cls({}, [{"Timestamp": _text(time)} for time in times_s.tolist()])

    def add(self, name: str, matrices: FloatArray, valid: BoolArray | None = None) -> None:
        """Give each frame a transform, shape (n, 4, 4), by a name as ``ProbeToTracker``."""
        if matrices.shape != (len(self.frames), 4, 4):
            raise InvalidInputError(
                f"{name}: expected shape ({len(self.frames)}, 4, 4), got {matrices.shape}"
            )
        for i, (frame, matrix) in enumerate(zip(self.frames, matrices, strict=True)):
            frame[f"{name}Transform"] = " ".join(map(_text, matrix.ravel()))
            frame[f"{name}TransformStatus"] = "OK" if valid is None or valid[i] else "INVALID"


def write_sequence(
    path: PathLike,
    sweep: Sweep,
    progress: Progress | None = None,
    compressed: bool = True,
    transforms: Mapping[str, FloatArray] | None = None,
) -> list[str]:
    """Write a sweep as a sequence of PLUS, of the container that the suffix names; memory stays flat.

    A tracker becomes ``ProbeToTrackerTransform`` and an orientation sensor
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
    rows, omitted = _rows_of(sweep)
    for name, matrices in (transforms or {}).items():
        rows.add(name, matrices)
        rows.fields["ElementSpacing"] = "1 1 1"
    layout = Layout(rows.fields["UltrasoundImageType"], rows.fields["UltrasoundImageOrientation"])
    images = _Images(sweep, layout, progress)
    if suffix == ".mhd":
        _write_two_files(target, images, rows, compressed)
        return omitted
    is_slicers = target.name.lower().endswith(_OF_SLICER)
    if suffix == ".nrrd":
        head = _nrrd_header(images, rows, "gzip" if compressed else "raw", is_slicers)
    else:
        kind = meta_type(images.dtype)
        head = _meta_header(rows, images.shape, kind, "LOCAL", 0 if compressed else None)
    with atomic_path(target) as part, part.open("wb") as file:
        file.write(head)
        size = images.write(file, (_GZIP if suffix == ".nrrd" else _ZLIB) if compressed else None)
        if compressed and suffix == ".mha":
            put_packed_size(file, head, size)
    return omitted


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
    rows = _Rows.of_times(times_s)
    for name, matrices in transforms.items():
        rows.add(name, matrices)
    with atomic_path(path) as part:
        part.write_bytes(_meta_header(rows, (0, 0, len(rows.frames)), "UCHAR", "LOCAL", None))


def _rows_of(sweep: Sweep) -> tuple[_Rows, list[str]]:
    """Fields of a sweep's sequence, and what a sequence does not hold of it."""
    times, grid, count = sweep.frame_time_s, sweep.grid, len(sweep)
    rows, omitted = _Rows.of_times(times), list[str]()
    for frame in rows.frames:
        frame["ImageStatus"] = "OK"
    sizes = grid.vector_pitch_mm, grid.sample_spacing_mm, grid.first_sample_depth_mm
    sensors: tuple[tuple[Tracker | OrientationSensor | None, str, str], ...] = (
        (sweep.tracker, "Probe", "Tracker"), (sweep.orientation, ORIENTATION, "World")
    )  # fmt: skip
    for sensor, own, world in sensors:
        if sensor is None:
            continue
        at = times - sensor.time_offset_s
        covered = sensor.readings.covers(at)
        matrices = np.tile(np.eye(4), (count, 1, 1))
        if covered.any():
            posed = sensor.readings.at(at[covered]).as_matrix()
            size = posed.shape[-1]  # 3 of rotations
            matrices[np.flatnonzero(covered), :size, :size] = posed
        rows.add(f"{own}To{world}", matrices, covered)
        if sensor is sweep.orientation or not np.array_equal(sensor.readings.time_s, at[covered]):
            omitted.append(
                f"the {sensor.label}'s {len(sensor.readings)} readings with all that it measured: "
                f"{np.count_nonzero(covered)} interpolated ones are at the times of {count} frames"
            )
        if (mounting := sensor.sensor_from_image) is not None:
            if isinstance(mounting, Rotation):
                mounting = RigidTransform.from_rotation(mounting)
            skew_rad = sensor.image_skew_rad if isinstance(sensor, Tracker) else 0.0
            rows.add(f"{IMAGE}To{own}", np.tile(image_matrix(mounting, *sizes, skew_rad), (count, 1, 1)))
    if sweep.truth is not None:
        omitted.append("the true poses")
    rows.fields.update(_standard_fields(sweep))
    return rows, omitted


def _standard_fields(sweep: Sweep) -> dict[str, str]:
    """Fields of PLUS, and this package's own.

    Spacing is 1 where transforms count pixels, as in PLUS: a viewer that knew both would apply it twice.
    """
    grid, signal = sweep.grid, sweep.signal
    is_rf = isinstance(signal, RFSettings)
    kind = "BRIGHTNESS" if not is_rf else "RF_IQ_LINE" if sweep.frames.dtype.kind == "c" else "RF_REAL"
    sizes = (grid.vector_pitch_mm, grid.sample_spacing_mm)
    calibrated = sweep.tracker is not None and sweep.tracker.sensor_from_image is not None
    spacing = (1.0, 1.0) if calibrated else sizes[::-1] if is_rf else sizes
    names = ("vector_pitch_mm",) if is_rf else ("column_pitch_mm", "row_spacing_mm")
    own: dict[str, Any] = {name: value for name, value in vars(signal).items() if value is not None}
    own |= {"first_sample_depth_mm": grid.first_sample_depth_mm, **dict(zip(names, sizes, strict=False))}
    texts = {name: " ".join(map(_text, np.ravel(value))) for name, value in own.items()}
    if sweep.probe:
        texts["probe"] = " ".join(sweep.probe.split())
    return {
        "UltrasoundImageOrientation": "FM" if is_rf else "MF",
        "UltrasoundImageType": kind,
        "ElementSpacing": " ".join(map(_text, (*spacing, 1.0))),
        "Offset": "0 0 0",
        "TransformMatrix": "1 0 0 0 1 0 0 0 1",
        "CenterOfRotation": "0 0 0",
        "AnatomicalOrientation": "RAI",
        **{_PREFIX + name: text for name, text in texts.items()},
    }


def _text(value: float) -> str:
    """Write a number so that reading gives it back exactly."""
    return repr(float(value)).removesuffix(".0")


@dataclass(frozen=True)
class _Images:
    """Pixels to write."""

    sweep: Sweep
    layout: Layout
    progress: Progress | None

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the numbers, of I and Q each."""
        dtype = self.sweep.frames.dtype
        if dtype.kind != "c":
            return dtype
        return np.dtype(np.int16 if stored_dtype(self.sweep.frames) == np.int16 else np.float32)

    @cached_property
    def shape(self) -> tuple[int, int, int]:
        """Lengths of the axes, fastest first."""
        y, x = self.layout.pixels(self.sweep.frames[0]).shape
        return x, y, len(self.sweep)

    def write(self, file: BinaryIO, window: int | None) -> int:
        """Write all images, packed if there is a window, and return how many bytes that took."""
        packer = None if window is None else _packer(window)
        size = 0
        for i in range(len(self.sweep)):
            image = self.layout.pixels(self.sweep.frames[i])
            raw = image.astype(self.dtype.newbyteorder("<"), order="C").data.cast("B")
            size += file.write(raw if packer is None else packer.compress(raw))
            if self.progress is not None:
                self.progress(i + 1, len(self.sweep))
        return size if packer is None else size + file.write(packer.flush())


def _packer(window: int) -> Any:
    """Return ISA-L's packer, or zlib's where that has no wheel."""
    try:
        from isal import isal_zlib
    except ImportError:
        return zlib.compressobj(_LEVEL, zlib.DEFLATED, window)
    return isal_zlib.compressobj(_LEVEL, zlib.DEFLATED, window)


def _write_two_files(target: Path, images: _Images, rows: _Rows, compressed: bool) -> None:
    """Write a header and the file of its pixels, both or none."""
    beside = f"{target.stem}.{'zraw' if compressed else 'raw'}"
    data = target.with_name(beside)
    if data.exists() and not (target.exists() and read_header(target).pixels.path == data.resolve()):
        raise InvalidInputError(f"{data}: is there and no part of {target.name}: give another name")
    others = {f"{target.stem}.{suffix}" for suffix in ("raw", "zraw")} - {beside}
    old = tuple(others & ({read_header(target).pixels.path.name} if target.exists() else set()))
    with FileSet(target.name, (beside,), old).replaced(target.parent) as part:
        try:
            with (part / beside).open("wb") as file:
                size = images.write(file, _ZLIB if compressed else None)
            packed = size if compressed else None
            head = _meta_header(rows, images.shape, meta_type(images.dtype), beside, packed)
            (part / target.name).write_bytes(head)
        except Speckle3DError:
            raise
        except OSError as error:
            raise cannot_write(target, error) from error


def _frame_lines(rows: _Rows, sign: str) -> Iterator[str]:
    for i, frame in enumerate(rows.frames):
        yield from (f"Seq_Frame{i:04d}_{name}{sign}{value}" for name, value in frame.items())


def _meta_header(rows: _Rows, shape: tuple[int, int, int], kind: str, data: str, packed: int | None) -> bytes:
    fields = {"ElementSpacing": "1 1 1", **rows.fields}
    lines = [
        *meta_start(3, packed),
        f"DimSize = {_spaced(shape)}",
        f"ElementType = MET_{kind}",
        "Kinds = domain domain list",
        *(f"{name} = {value}" for name, value in fields.items()),
        *_frame_lines(rows, " = "),
        f"ElementDataFile = {data}",
    ]
    return header_bytes(lines)


def _nrrd_header(images: _Images, rows: _Rows, encoding: str, is_slicers: bool) -> bytes:
    fields = dict(rows.fields)
    x, y, *_ = fields.pop("ElementSpacing").split()
    lines = [
        "NRRD0004",
        f"type: {nrrd_type(images.dtype)}",
        *(_slicers_axes if is_slicers else _axes)(images.shape, x, y),
        "endian: little",
        f"encoding: {encoding}",
        *(f"{_NRRD_NAMES.get(name, name)}:={value}" for name, value in fields.items()),
        *_frame_lines(rows, ":="),
        # Slicer reads the transforms up to the first line of more than 1,000 characters.
        *(_slicers_index(rows) if is_slicers else ()),
        "",
    ]
    return header_bytes(lines)


def _axes(shape: tuple[int, int, int], x: str, y: str) -> list[str]:
    """Axes of an image, and one of frames, in a plane: as PLUS writes them."""
    return [
        "dimension: 3",
        "space dimension: 2",
        f"sizes: {_spaced(shape)}",
        f"space directions: ({x},0) (0,{y}) none",
        "kinds: domain domain list",
        "space origin: (0,0)",
    ]


def _slicers_axes(shape: tuple[int, int, int], x: str, y: str) -> list[str]:
    """Axes of images one pixel thick in space, and one of frames; transforms count pixels from its origin."""
    return [
        "dimension: 4",
        "space: right-anterior-superior",
        f"sizes: {shape[0]} {shape[1]} 1 {shape[2]}",
        f"space directions: ({x},0,0) (0,{y},0) (0,0,1) none",
        "kinds: domain domain domain list",
        'labels: "" "" "" "time"',
        'units: "" "" "" "s"',
        "space origin: (0,0,0)",
    ]


def _spaced(values: Iterable[object]) -> str:
    return " ".join(map(str, values))


def _slicers_index(rows: _Rows) -> Iterator[str]:
    """Frames' times, by which Slicer finds what belongs together; it rounds those of transforms to 1 ms."""
    yield "DataNodeClassName:=vtkMRMLScalarVolumeNode"
    times = [f"{float(frame['Timestamp']):.3f}" for frame in rows.frames]
    index = " ".join(times if len({*times}) == len(times) else map(str, range(len(times))))
    # Up to version 5.6 Slicer knew the axis of frames as the first.
    for axis in (3, 0):
        yield f"axis {axis} index type:=numeric"
        yield f"axis {axis} index values:={index}"
