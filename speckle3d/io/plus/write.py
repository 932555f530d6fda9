"""Writing of a sweep as a sequence of PLUS, image by image.

References
----------
.. [1] PLUS user manual, "Sequence file".
.. [2] G. Kindlmann, "Definition of NRRD File Format", teem.sourceforge.net.
.. [3] 3D Slicer developer guide, "Volume sequence file format (.seq.nrrd)".
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import AnyArray, BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.core.geometry import rigid
from speckle3d.core.progress import Progress
from speckle3d.core.sweep import RFSettings, Sweep, stored_dtype
from speckle3d.io.hdf5 import atomic_path, require_suffix
from speckle3d.io.images.headers import NRRD_NAMES, write_image
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.plus.transforms import IMAGE, ORIENTATION, pixel_matrix
from speckle3d.io.text import number_text, numbers

SUFFIXES = (".mha", ".nrrd")
"""Of the files that `write_sequence` writes, as .igs.mha."""

_META_AXES = """Kinds = domain domain list
Offset = 0 0 0
TransformMatrix = 1 0 0 0 1 0 0 0 1
CenterOfRotation = 0 0 0
AnatomicalOrientation = RAI"""
_NRRD_AXES = """space: right-anterior-superior
space directions: ({0},0,0) (0,{1},0) (0,0,1) none
kinds: domain domain domain list
labels: "" "" "" "time"
units: "" "" "" "s"
space origin: (0,0,0)"""
"""With four axes, the last of them the frames, as 3D Slicer reads it [3]_, and IGSIO, with which PLUS does;
images are one pixel thick in space, and transforms count pixels from its origin."""
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
    values: dict[str, Any] = {}
    for name in (*ImportSettings.model_fields, "full_scale"):
        if (text := fields.get(_PREFIX + name)) is not None:
            count = 2 if name == "bandwidth_hz" else 1
            parts = (text,) if name == "probe" else numbers(text, count, f"{path}: {_PREFIX}{name}")
            values[name] = parts if count > 1 else parts[0]
    return values


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
    suffix = require_suffix(path, SUFFIXES)
    if sweep.grid.fan is not None:
        raise InvalidInputError(
            f"{path}: expected parallel vectors, got a fan's, which a sequence does not hold: write .h5"
        )
    fields = _standard_fields(sweep) | _column("Timestamp", map(number_text, sweep.frame_time_s))
    omissions = [*_add_sensors(fields, sweep)]
    for transform, matrices in (transforms or {}).items():
        fields |= {"ElementSpacing": "1 1 1", **_transform(transform, matrices)}
    dtype = sweep.frames.dtype
    if dtype.kind == "c":
        dtype = np.dtype(np.int16 if stored_dtype(sweep.frames) == np.int16 else np.float32)
    shape, axes = (*_pixels(sweep.frames[0]).shape[::-1], len(sweep)), _META_AXES
    if suffix == ".nrrd":
        axes, shape = _NRRD_AXES.format(*fields.pop("ElementSpacing").split()), (*shape[:2], 1, shape[2])
        fields = {_NRRD_NAMES.get(name, name): value for name, value in fields.items()}
        fields |= _slicer_fields(sweep.frame_time_s)

    def planes() -> Iterator[AnyArray]:
        for i in range(len(sweep)):
            yield _pixels(sweep.frames[i]).astype(dtype, copy=False)
            if progress is not None:
                progress(i + 1, len(sweep))

    with atomic_path(path) as part:
        write_image(part, planes(), shape, dtype, axes, fields, compressed)
    return omissions


def _pixels(frame: AnyArray) -> AnyArray:
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
    fields = {"ElementSpacing": "1 1 1", **_column("Timestamp", map(number_text, times_s))}
    for name, matrices in transforms.items():
        fields |= _transform(name, matrices)
    with atomic_path(path) as part:
        write_image(part, (), (0, 0, times_s.size), np.dtype(np.uint8), _META_AXES, fields)


def _column(name: str, texts: Iterable[str]) -> dict[str, str]:
    """A field of each frame."""
    return {f"Seq_Frame{i:04d}_{name}": text for i, text in enumerate(texts)}


def _transform(name: str, matrices: FloatArray, valid: BoolArray | None = None) -> dict[str, str]:
    """Fields of each frame's transform, shape (n, 4, 4), by a name as ``ProbeToTracker``."""
    statuses = ["OK"] * len(matrices) if valid is None else np.where(valid, "OK", "INVALID")
    return {
        **_column(f"{name}Transform", map(number_text, matrices)),
        **_column(f"{name}TransformStatus", statuses),
    }


def _add_sensors(fields: dict[str, str], sweep: Sweep) -> Iterator[str]:
    """Give each frame the sensors' poses, and tell what a sequence does not hold of the sweep."""
    times, count = sweep.frame_time_s, len(sweep)
    fields |= _column("ImageStatus", ["OK"] * count)
    for name, tool, world in (("tracker", "Probe", "Tracker"), ("orientation", ORIENTATION, "World")):
        if (sensor := getattr(sweep, name)) is None:
            continue
        at = times - sensor.time_offset_s
        reach, matrices = sensor.readings.covers(at), RigidTransform.identity(count).as_matrix()
        if reach.any():
            matrices[reach] = rigid(sensor.readings.at(at[reach])).as_matrix()
        fields |= _transform(f"{tool}To{world}", matrices, reach)
        if name == "orientation" or not np.array_equal(sensor.readings.time_s, at[reach]):
            yield (
                f"the {sensor.label}'s {len(sensor.readings)} readings with all that it measured: "
                f"{np.count_nonzero(reach)} interpolated ones are at the times of {count} frames"
            )
        if (mounting := sensor.sensor_from_image) is not None:
            grid = replace(sweep.grid, skew_rad=getattr(sensor, "image_skew_rad", 0.0))
            pixels = rigid(mounting).as_matrix() @ pixel_matrix(grid)
            fields |= _transform(f"{IMAGE}To{tool}", np.tile(pixels, (count, 1, 1)))
    if sweep.truth is not None:
        yield "the true poses"


def _standard_fields(sweep: Sweep) -> dict[str, str]:
    """Fields of PLUS, and this package's own.

    Spacing is 1 where transforms count pixels, as in PLUS: a viewer that knew both would apply it twice.
    """
    grid, signal = sweep.grid, sweep.signal
    is_rf = isinstance(signal, RFSettings)
    kind = "BRIGHTNESS" if not is_rf else "RF_IQ_LINE" if sweep.frames.dtype.kind == "c" else "RF_REAL"
    sizes = (grid.vector_pitch_mm, grid.sample_spacing_mm)
    counts_pixels = sweep.tracker is not None and sweep.tracker.sensor_from_image is not None
    spacing = (1.0, 1.0) if counts_pixels else sizes[::-1] if is_rf else sizes
    names = ("vector_pitch_mm",) if is_rf else ("column_pitch_mm", "row_spacing_mm")
    values: dict[str, Any] = {name: value for name, value in vars(signal).items() if value is not None}
    if values.pop("dynamic_range_sigma_db", 0.0):
        del values["dynamic_range_db"]  # which is estimated from the images as it was
    values |= {"first_sample_depth_mm": grid.first_sample_depth_mm, **dict(zip(names, sizes, strict=False))}
    texts = {name: number_text(value) for name, value in values.items()}
    if sweep.probe:
        texts["probe"] = " ".join(sweep.probe.split())
    return {
        "UltrasoundImageOrientation": "FM" if is_rf else "MF",
        "UltrasoundImageType": kind,
        "ElementSpacing": number_text((*spacing, 1.0)),
        **{_PREFIX + name: text for name, text in texts.items()},
    }


def _slicer_fields(times_s: FloatArray) -> dict[str, str]:
    # Slicer finds what belongs together by frames' times; it rounds those of transforms to 1 ms.
    times = [f"{time:.3f}" for time in times_s]
    values = " ".join(times if len({*times}) == len(times) else map(str, range(len(times))))
    # Slicer reads the transforms up to the first line of more than 1,000 characters.
    fields = {"DataNodeClassName": "vtkMRMLScalarVolumeNode"}
    for axis in (3, 0):  # up to version 5.6 Slicer knew the axis of frames as the first
        fields |= {f"axis {axis} index type": "numeric", f"axis {axis} index values": values}
    return fields
