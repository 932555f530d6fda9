"""Writing of a sweep as a sequence of PLUS, image by image.

References
----------
.. [1] PLUS user manual, "Sequence file".
.. [2] G. Kindlmann, "Definition of NRRD File Format", teem.sourceforge.net.
.. [3] 3D Slicer developer guide, "Volume sequence file format (.seq.nrrd)".
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.core.progress import Progress
from speckle3d.core.sweep import OrientationSensor, RFSettings, Sweep, Tracker, stored_dtype
from speckle3d.io.hdf5 import atomic_path
from speckle3d.io.headers import (
    GZIP,
    NRRD_NAMES,
    ZLIB,
    header_bytes,
    meta_start,
    meta_type,
    nrrd_type,
    packer,
    put_packed_size,
)
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.plus.transforms import IMAGE, ORIENTATION, image_matrix
from speckle3d.io.text import numbers

SUFFIXES = (".mha", ".nrrd")
"""Of the files that `write_sequence` writes, as .igs.mha."""

_OF_SLICER = ".seq.nrrd"
"""With four axes, the last of them the frames, as 3D Slicer reads it [3]_; other NRRD files have three."""

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
    for name in (*ImportSettings.model_fields, "full_scale", "dynamic_range_sigma_db"):
        if (text := fields.get(_PREFIX + name)) is not None and name != "probe":
            values = numbers(text, 2 if name == "bandwidth_hz" else 1, f"{path}: {_PREFIX}{name}")
            own[name] = values if len(values) == 2 else values[0]
        elif text is not None:
            own[name] = text
    return own


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
        With a suffix of `SUFFIXES`.
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
        If the suffix is another, or the vectors are a fan's.
    FileError
        If the file cannot be written.
    """
    target, name = Path(path), Path(path).name.lower()
    if not name.endswith(SUFFIXES):
        raise InvalidInputError(f"{path}: expected a name ending in {' or '.join(SUFFIXES)}")
    if sweep.grid.fan is not None:
        raise InvalidInputError(
            f"{path}: expected parallel vectors, got a fan's, which a sequence does not hold: write .h5"
        )
    fields, frames = _standard_fields(sweep), _timed(sweep.frame_time_s)
    omitted = _add_sensors(frames, sweep)
    for transform, matrices in (transforms or {}).items():
        _add(frames, transform, matrices)
        fields["ElementSpacing"] = "1 1 1"
    dtype, is_nrrd = sweep.frames.dtype, name.endswith(".nrrd")
    if dtype.kind == "c":
        dtype = np.dtype(np.int16 if stored_dtype(sweep.frames) == np.int16 else np.float32)
    shape = (*_pixels(sweep.frames[0]).shape[::-1], len(sweep))
    if is_nrrd:
        encoding = "gzip" if compressed else "raw"
        head = _nrrd_header(fields, frames, shape, nrrd_type(dtype), encoding, name.endswith(_OF_SLICER))
    else:
        head = _meta_header(fields, frames, shape, meta_type(dtype), 0 if compressed else None)
    pack = packer(GZIP if is_nrrd else ZLIB) if compressed else None
    with atomic_path(target) as place, place.open("wb") as file:
        file.write(head)
        for i in range(len(sweep)):
            raw = _pixels(sweep.frames[i]).astype(dtype.newbyteorder("<"), order="C").data.cast("B")
            file.write(raw if pack is None else pack.compress(raw))
            if progress is not None:
                progress(i + 1, len(sweep))
        if pack is not None:
            file.write(pack.flush())
            if not is_nrrd:
                put_packed_size(file, head, file.tell() - len(head))
    return omitted


def _pixels(frame: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Pixels (y, x) of a frame (vector, sample): lines of echoes in rows, I and Q in turn; images upright."""
    if frame.dtype.kind == "c":
        return np.stack([frame.real, frame.imag], axis=2).reshape(len(frame), -1)
    return frame.T if frame.dtype == np.uint8 else frame


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
    frames = _timed(times_s)
    for name, matrices in transforms.items():
        _add(frames, name, matrices)
    with atomic_path(path) as part:
        part.write_bytes(_meta_header({}, frames, (0, 0, len(frames)), "UCHAR", None))


def _timed(times_s: FloatArray) -> list[dict[str, str]]:
    """Fields of each frame, with its time."""
    return [{"Timestamp": _text(time)} for time in times_s.tolist()]


def _add(
    frames: list[dict[str, str]], name: str, matrices: FloatArray, valid: BoolArray | None = None
) -> None:
    """Give each frame a transform, shape (n, 4, 4), by a name as ``ProbeToTracker``."""
    for i, (frame, matrix) in enumerate(zip(frames, matrices, strict=True)):
        frame[f"{name}Transform"] = " ".join(map(_text, matrix.ravel()))
        frame[f"{name}TransformStatus"] = "OK" if valid is None or valid[i] else "INVALID"


def _add_sensors(frames: list[dict[str, str]], sweep: Sweep) -> list[str]:
    """Give each frame the sensors' poses, and tell what a sequence does not hold of the sweep."""
    times, grid, omitted = sweep.frame_time_s, sweep.grid, list[str]()
    for frame in frames:
        frame["ImageStatus"] = "OK"
    sizes = grid.vector_pitch_mm, grid.sample_spacing_mm, grid.first_sample_depth_mm
    sensors: tuple[tuple[Tracker | OrientationSensor | None, str, str], ...] = (
        (sweep.tracker, "Probe", "Tracker"), (sweep.orientation, ORIENTATION, "World")
    )  # fmt: skip
    for sensor, own, world in sensors:
        if sensor is None:
            continue
        at = times - sensor.time_offset_s
        covered, matrices = sensor.readings.covers(at), np.tile(np.eye(4), (len(frames), 1, 1))
        if covered.any():
            posed = sensor.readings.at(at[covered]).as_matrix()
            size = posed.shape[-1]  # 3 of rotations
            matrices[np.flatnonzero(covered), :size, :size] = posed
        _add(frames, f"{own}To{world}", matrices, covered)
        if sensor is sweep.orientation or not np.array_equal(sensor.readings.time_s, at[covered]):
            omitted.append(
                f"the {sensor.label}'s {len(sensor.readings)} readings with all that it measured: "
                f"{np.count_nonzero(covered)} interpolated ones are at the times of {len(frames)} frames"
            )
        if (mounting := sensor.sensor_from_image) is not None:
            if isinstance(mounting, Rotation):
                mounting = RigidTransform.from_rotation(mounting)
            skew_rad = sensor.image_skew_rad if isinstance(sensor, Tracker) else 0.0
            first = RigidTransform.from_translation([grid.first_vector_mm, 0.0, 0.0])
            pixels = image_matrix(mounting * first, *sizes, skew_rad)
            _add(frames, f"{IMAGE}To{own}", np.tile(pixels, (len(frames), 1, 1)))
    return omitted if sweep.truth is None else [*omitted, "the true poses"]


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
    if own.pop("dynamic_range_sigma_db", 0.0):
        del own["dynamic_range_db"]  # which is estimated from the images as it was
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


def _frame_lines(frames: list[dict[str, str]], sign: str) -> list[str]:
    return [
        f"Seq_Frame{i:04d}_{name}{sign}{value}"
        for i, frame in enumerate(frames)
        for name, value in frame.items()
    ]


def _meta_header(
    fields: dict[str, str],
    frames: list[dict[str, str]],
    shape: tuple[int, int, int],
    kind: str,
    packed: int | None,
) -> bytes:
    lines = [
        *meta_start(packed),
        f"DimSize = {_spaced(shape)}",
        f"ElementType = MET_{kind}",
        "Kinds = domain domain list",
        *(f"{name} = {value}" for name, value in {"ElementSpacing": "1 1 1", **fields}.items()),
        *_frame_lines(frames, " = "),
        "ElementDataFile = LOCAL",
    ]
    return header_bytes(lines)


def _nrrd_header(
    fields: dict[str, str],
    frames: list[dict[str, str]],
    shape: tuple[int, int, int],
    kind: str,
    encoding: str,
    is_slicers: bool,
) -> bytes:
    """Header of images with an axis of frames: in a plane, as PLUS writes them, or as Slicer's.

    Slicer's are one pixel thick in space; transforms count pixels from its origin.
    """
    plain = dict(fields)
    x, y, *_ = plain.pop("ElementSpacing").split()
    axes = [
        "dimension: 3",
        "space dimension: 2",
        f"sizes: {_spaced(shape)}",
        f"space directions: ({x},0) (0,{y}) none",
        "kinds: domain domain list",
        "space origin: (0,0)",
    ]
    index = []
    if is_slicers:
        axes = [
            "dimension: 4",
            "space: right-anterior-superior",
            f"sizes: {shape[0]} {shape[1]} 1 {shape[2]}",
            f"space directions: ({x},0,0) (0,{y},0) (0,0,1) none",
            "kinds: domain domain domain list",
            'labels: "" "" "" "time"',
            'units: "" "" "" "s"',
            "space origin: (0,0,0)",
        ]
        # Slicer finds what belongs together by frames' times; it rounds those of transforms to 1 ms.
        times = [f"{float(frame['Timestamp']):.3f}" for frame in frames]
        told = _spaced(times if len({*times}) == len(times) else range(len(times)))
        # Up to version 5.6 Slicer knew the axis of frames as the first.
        index = [
            line
            for axis in (3, 0)
            for line in (f"axis {axis} index type:=numeric", f"axis {axis} index values:={told}")
        ]
        index.insert(0, "DataNodeClassName:=vtkMRMLScalarVolumeNode")
    lines = [
        "NRRD0004",
        f"type: {kind}",
        *axes,
        "endian: little",
        f"encoding: {encoding}",
        *(f"{_NRRD_NAMES.get(key, key)}:={value}" for key, value in plain.items()),
        *_frame_lines(frames, ":="),
        # Slicer reads the transforms up to the first line of more than 1,000 characters.
        *index,
        "",
    ]
    return header_bytes(lines)


def _spaced(values: Iterable[object]) -> str:
    return " ".join(map(str, values))
