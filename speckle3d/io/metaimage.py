"""Image sequences in MetaImage and NRRD files, as PLUS, ITK and ultrasound machines write them.

PLUS's names stay in this module and `headers`: ``ImageToProbe`` in pixels, ``ProbeToTracker``,
orientations such as ``MF`` (x towards the marked side, y far from the probe).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.geometry import nearest_rotation, require_increasing, transforms_from_matrices
from speckle3d.core.printable import printable
from speckle3d.core.streams import TimedPoses
from speckle3d.core.sweep import BModeSettings, Frames, ImageGrid, RFSettings, Sweep, Tracker
from speckle3d.io.hdf5 import PathLike
from speckle3d.io.headers import SequenceHeader, is_metaimage, is_nrrd, read_header
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings, MissingSettingsError
from speckle3d.io.pixels import read_pixels
from speckle3d.io.readers import Reader
from speckle3d.io.text import numbers

SKEW_TOLERANCE = 0.1
"""How far the axes of a measured image calibration may be from square, as the cosine of their angle. PLUS's
published calibrations reach 0.05, an error of the calibration and not of the image."""

ROUNDING_TOLERANCE = 2e-3
"""How far R^T R of a pose in a header may be from the identity before it is made rigid. An electromagnetic
tracker that rounds its own output was measured at 4.6e-4; six written digits alone give 2e-6."""

Value = TypeVar("Value")

_RF_TYPES = ("RF_REAL", "RF_IQ_LINE", "RF_I_LINE_Q_LINE")


def read_metaimage(path: PathLike, overrides: ImportSettings | None = None) -> Sweep:
    """Read an image sequence with the poses in its header; the frames are held in memory.

    Frames are turned so that vectors run from the unmarked to the marked side and samples away from the
    probe. Frames whose status is not OK are left out. I and Q become one analytic (complex64) signal.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        Naming the field, or the setting to give where the header lacks one.
    """
    settings = overrides or ImportSettings()
    header = read_header(path)
    if 0 in header.size:
        raise InvalidInputError(f"{path}: expected pixels, got an image of size {header.size}")
    kept = _frames_kept(header)
    pixels = _read_pixels(header)
    frames = _to_samples(header, pixels if kept.all() else pixels[kept])
    grid, signal = _geometry(header, settings, frames)
    return Sweep(
        frames=cast(Frames, frames),
        grid=grid,
        signal=signal,
        frame_time_s=_frame_times(header, settings)[kept],
        tracker=_tracker(header, settings),
        name=printable(Path(path).name.split(".")[0]),
    )


def read_poses(path: PathLike, overrides: ImportSettings | None = None) -> Tracker:
    """Read the tracked poses in a header, whether or not there are images.

    Raises
    ------
    InvalidInputError
        If the header names no such transform, or no sample of it is valid.
    """
    header = read_header(path)
    tracker = _tracker(header, overrides or ImportSettings())
    if tracker is None:
        raise InvalidInputError(
            f"{path}: expected tracked poses (fields like ProbeToTrackerTransform), got {lacking_poses(path)}"
        )
    return tracker


def lacking_poses(path: PathLike) -> str:
    """Say which transforms an image sequence holds, if not those of the usual names."""
    header = read_header(path)
    return f"{', '.join(header.transforms) or 'none'}{_any_of(header)}"


def _any_of(header: SequenceHeader) -> str:
    return ": name the sensor's with --transform" if header.transforms else ""


def _geometry(
    header: SequenceHeader, settings: ImportSettings, frames: npt.NDArray[Any]
) -> tuple[ImageGrid, RFSettings | BModeSettings]:
    _, vectors, samples = frames.shape
    lateral_mm, axial_mm = _header_spacing(header)
    with naming(header.path):
        if image_type(header) in _RF_TYPES:
            rf = _rf_settings(header, settings, axial_mm)
            pitch = _need(header, "vector_pitch_mm", settings.vector_pitch_mm, lateral_mm)
            spacing = rf.sample_spacing_mm
            return ImageGrid(vectors, samples, pitch, spacing, settings.first_sample_depth_mm or 0.0), rf
        if settings.image_to_probe is not None:
            lateral_mm, axial_mm = np.linalg.norm(_calibration(settings)[:3, :2], axis=0).tolist()
        pitch = _need(header, "column_pitch_mm", settings.column_pitch_mm, lateral_mm)
        spacing = _need(header, "row_spacing_mm", settings.row_spacing_mm, axial_mm)
        bmode = BModeSettings(_need(header, "dynamic_range_db", settings.dynamic_range_db, None))
        return ImageGrid(vectors, samples, pitch, spacing, settings.first_sample_depth_mm or 0.0), bmode


def _rf_settings(header: SequenceHeader, settings: ImportSettings, axial_mm: float | None) -> RFSettings:
    speed = settings.speed_of_sound_m_s or SPEED_OF_SOUND_M_S
    implied = None if axial_mm is None else 1e3 * speed / (2.0 * axial_mm)
    rate = _need(header, "sampling_rate_hz", settings.sampling_rate_hz, implied)
    centre = _need(header, "centre_frequency_hz", settings.centre_frequency_hz, None)
    # I and Q become the analytic signal, which still carries its frequency, unless settings give another.
    analytic = None if image_type(header) == "RF_REAL" else settings.demodulation_frequency_hz or 0.0
    return RFSettings(
        rate, speed, centre, _need(header, "bandwidth_hz", settings.bandwidth_hz, None), analytic
    )


def _need(header: SequenceHeader, name: str, given: Value | None, read: Value | None) -> Value:
    value = read if given is None else given
    if value is None:
        raise MissingSettingsError(header.path, (name,))
    return value


def _header_spacing(header: SequenceHeader) -> tuple[float | None, float | None]:
    """Lateral and axial spacing, mm."""
    if header.spacing_mm is None:
        return None, None
    x, y = header.spacing_mm
    return (y, x) if image_orientation(header).startswith(("F", "N")) else (x, y)


def _frames_kept(header: SequenceHeader) -> npt.NDArray[np.bool_]:
    if not header.frames:
        return np.ones(header.frame_count, dtype=bool)
    if len(header.frames) != header.frame_count:
        raise InvalidInputError(
            f"{header.path}: expected the fields of {header.frame_count} frames, got {len(header.frames)}"
        )
    kept = np.array([_status(frame, "ImageStatus", "Status") for frame in header.frames])
    if not kept.any():
        raise InvalidInputError(f"{header.path}: ImageStatus: expected a valid frame, got none")
    return kept


def _status(frame: dict[str, str], *names: str) -> bool:
    return all(frame.get(name, "OK") == "OK" for name in names)


def _frame_times(header: SequenceHeader, settings: ImportSettings) -> FloatArray:
    if settings.frame_rate_hz is not None:
        if not settings.frame_rate_hz > 0:
            raise InvalidInputError(f"frame_rate_hz: expected above zero, got {settings.frame_rate_hz}")
        return np.arange(header.frame_count) / settings.frame_rate_hz
    return _timestamps(header) if header.frames else _need(header, "frame_rate_hz", None, None)


def _timestamps(header: SequenceHeader) -> FloatArray:
    where = f"{header.path}: Timestamp"
    texts = [frame.get("Timestamp", "") for frame in header.frames]
    times = [numbers(text, 1, f"{where}[{i}]")[0] for i, text in enumerate(texts)]
    return require_increasing(times, where)


def _tracker(header: SequenceHeader, settings: ImportSettings) -> Tracker | None:
    sensor = _transform(header, settings.tracker_transform, "ProbeToTracker")
    if sensor is None:
        return None
    # Poses may be asked for by any name; a reference counts if both are tracked in the same world.
    moving, world = _ends(sensor.name)
    usual = "none" if moving == "Reference" else f"ReferenceTo{world}"
    reference = _transform(header, settings.reference_transform, usual)
    both = (sensor,) if reference is None else (sensor, reference)
    valid = np.array(
        [_status(frame, *(f"{one.held}TransformStatus" for one in both)) for frame in header.frames]
    )
    if not valid.any():
        raise InvalidInputError(
            f"{header.path}: {sensor.held}TransformStatus: expected a valid one, got none"
        )
    poses = _poses(header, sensor, valid)
    if reference is not None:
        poses = _poses(header, reference, valid).inv() * poses
    calibration = None if settings.image_to_probe is None else _probe_from_image(settings)
    return Tracker(TimedPoses(_timestamps(header)[valid], poses[valid]), calibration)


@dataclass(frozen=True)
class _Transform:
    """A tracked transform by the name asked for, and the one the header holds: that, or its inverse."""

    name: str
    held: str


def _transform(header: SequenceHeader, given: str | None, default: str) -> _Transform | None:
    """Find ``XToY``, which takes points of X to Y, or ``YToX``, its inverse."""
    name = default if given is None else given.removesuffix("Transform")
    if name == "none":
        return None
    moving, world = _ends(name)
    for held in (name, f"{world}To{moving}"):
        if any(f"{held}Transform" in frame for frame in header.frames):
            return _Transform(name, held)
    if given is not None:
        there = ", ".join(header.transforms) or "none"
        raise InvalidInputError(f"{header.path}: expected a transform {name}, got {there}")
    return None


def _ends(name: str) -> tuple[str, str]:
    """Split ``XToY`` as PLUS does, before a capital: ``ToolToTracker`` is of ``Tool`` in ``Tracker``."""
    found = re.fullmatch(r"(.+?)To([A-Z].*)", name)
    return (found[1], found[2]) if found else (name, "")


def _poses(header: SequenceHeader, asked: _Transform, valid: npt.NDArray[np.bool_]) -> RigidTransform:
    where = f"{header.path}: {asked.held}Transform"
    matrices = np.tile(np.eye(4), (len(header.frames), 1, 1))
    for i in np.flatnonzero(valid):
        text = header.frames[i].get(f"{asked.held}Transform", "")
        matrices[i] = np.reshape(numbers(text, 16, f"{where}[{i}]"), (4, 4))
    poses = transforms_from_matrices(_squared(matrices), where)
    return poses if asked.held == asked.name else poses.inv()


def _squared(matrices: FloatArray) -> FloatArray:
    """Make rounded rotations exact; matrices farther off stay, for `transforms_from_matrices` to refuse."""
    r = matrices[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        rounded = np.abs(r.transpose(0, 2, 1) @ r - np.eye(3)).max(axis=(1, 2)) < ROUNDING_TOLERANCE
    rounded[rounded] = np.linalg.det(r[rounded]) > 0
    squared = matrices.copy()
    squared[rounded, :3, :3] = nearest_rotation(r[rounded])
    return squared


def _probe_from_image(settings: ImportSettings) -> RigidTransform:
    """Nearest rigid transform to PLUS's image calibration, by singular values."""
    matrix = _calibration(settings)
    axes = matrix[:3, :2] / np.linalg.norm(matrix[:3, :2], axis=0)
    cosine = float(axes[:, 0] @ axes[:, 1])
    if abs(cosine) > SKEW_TOLERANCE:
        raise InvalidInputError(f"image_to_probe: expected square axes, got cosine {cosine:.3f}")
    return RigidTransform.from_components(matrix[:3, 3], Rotation.from_matrix(nearest_rotation(axes)))


def _calibration(settings: ImportSettings) -> FloatArray:
    matrix = np.asarray(settings.image_to_probe, dtype=float)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InvalidInputError(f"image_to_probe: expected a finite 4x4 matrix, got shape {matrix.shape}")
    if not (np.linalg.norm(matrix[:3, :2], axis=0) > 0).all():
        raise InvalidInputError("image_to_probe: expected axes of some length, got zero")
    return matrix


def image_type(header: SequenceHeader) -> str:
    """PLUS's image type, told from the pixels where the header does not say."""
    named = header.fields.get("UltrasoundImageType")
    if named is not None:
        return named
    pixel = header.fields.get("ElementType") or header.fields.get("type", "")
    return "BRIGHTNESS" if pixel in ("MET_UCHAR", "uint8", "unsigned char", "uchar") else "RF_REAL"


def image_orientation(header: SequenceHeader) -> str:
    """PLUS's image orientation, its defaults where the header does not say: MF for B-mode, FM for RF."""
    default = "FM" if image_type(header) in _RF_TYPES else "MF"
    return header.fields.get("UltrasoundImageOrientation", default).upper()


def _read_pixels(header: SequenceHeader) -> npt.NDArray[Any]:
    """Pixels as (frame, second axis, first axis)."""
    expected = (header.frame_count, header.size[1], header.size[0])
    if header.pixels.count != math.prod(expected):
        raise InvalidInputError(
            f"{header.path}: expected grey pixels {expected}, got {header.pixels.count} numbers"
        )
    return read_pixels(header.pixels).reshape(expected)


def _to_samples(header: SequenceHeader, pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Turn pixels into frames (frame, vector, sample): marked side last, far side last.

    Returns
    -------
    ndarray
        uint8 for B-mode, int16 or float32 for RF, complex64 for I and Q.
    """
    kind, orientation = image_type(header), image_orientation(header)
    if kind not in (*_RF_TYPES, "BRIGHTNESS"):
        raise InvalidInputError(f"{header.path}: expected a grey B-mode or RF image, got type {kind}")
    if kind == "BRIGHTNESS" and pixels.dtype != np.uint8:
        raise InvalidInputError(f"{header.path}: expected B-mode of type uint8, got {pixels.dtype}")
    if kind == "RF_REAL":
        pixels = _narrowed(pixels)
    elif kind in _RF_TYPES:
        pixels = _analytic(header.path, pixels, orientation, kind)
    frames = _oriented(header.path, pixels, orientation)
    return _positive_carrier(frames) if np.iscomplexobj(frames) else frames


def _oriented(path: str, pixels: npt.NDArray[Any], orientation: str) -> npt.NDArray[Any]:
    """Turn (frame, y, x) into (frame, vector, sample), marked side last, far side last."""
    x, y = (*orientation, "", "")[:2]
    if not ((x in "MU" and y in "FN") or (x in "FN" and y in "MU")) or not (x and y):
        raise InvalidInputError(
            f"{path}: UltrasoundImageOrientation: expected as MF or FM, got {orientation}"
        )
    if x in "MU":
        pixels, x, y = pixels.transpose(0, 2, 1), y, x
    if x == "N":
        pixels = pixels[:, :, ::-1]
    if y == "U":
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def _narrowed(pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """RF as int16 where that loses nothing, else as float32."""
    limits = np.iinfo(np.int16)
    if pixels.dtype.kind in "iu" and pixels.min() >= limits.min and pixels.max() <= limits.max:
        return pixels.astype(np.int16, copy=False)
    return pixels.astype(np.float32)


def _analytic(path: str, pixels: npt.NDArray[Any], orientation: str, kind: str) -> npt.NDArray[np.complex64]:
    axis = 2 if orientation.startswith(("F", "N")) else 1
    if kind == "RF_I_LINE_Q_LINE":
        axis = 3 - axis
    if pixels.shape[axis] % 2:
        raise InvalidInputError(f"{path}: expected I and Q in pairs, got {pixels.shape[axis]}")
    turned = np.moveaxis(pixels, axis, 0)
    analytic = np.empty(turned[0::2].shape, dtype=np.complex64)
    analytic.real, analytic.imag = turned[0::2], turned[1::2]
    return np.moveaxis(analytic, 0, axis)


def _positive_carrier(frames: npt.NDArray[np.complex64]) -> npt.NDArray[np.complex64]:
    """Conjugate where the carrier turns backwards, as it does in a reversed line or with the other sign of Q.

    The phase between neighbouring samples is the carrier's mean turn, the first moment of the spectrum [1]_.

    References
    ----------
    .. [1] C. Kasai et al., "Real-time two-dimensional blood flow imaging using an autocorrelation
       technique", IEEE Trans. Sonics Ultrason. 32, 1985.
    """
    first = frames[0]
    turn = np.angle(np.vdot(first[:, :-1], first[:, 1:]))
    return np.conj(frames) if turn < 0 else frames


READER = Reader(
    "image",
    lambda _, start: is_metaimage(start) or is_nrrd(start),
    lambda path, settings: read_metaimage(path, settings),
)
