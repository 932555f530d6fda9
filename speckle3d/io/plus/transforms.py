"""Transforms of PLUS by frame: poses of a tracked tool, and where the image is on it.

``XToY`` takes points of X to Y, in mm; ``Image`` counts pixels of the image turned to columns and rows.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.geometry import nearest_rotation, require_increasing, transforms_from_matrices
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.io.plus.record import valid_frames
from speckle3d.io.text import numbers

SKEW_TOLERANCE = 0.1
"""How far the axes of a measured image calibration may be from square, as the cosine of their angle. PLUS's
published calibrations reach 0.05, an error of the calibration and not of the image."""

ROUNDING_TOLERANCE = 2e-3
"""How far R^T R of a pose in a header may be from the identity before it is made rigid. An electromagnetic
tracker that rounds its own output was measured at 4.6e-4; six written digits alone give 2e-6."""

_INVERSE_TOLERANCE_MM = 1.0
"""How far poses and their inverses, both in a header, may be apart: rotations rounded by up to
`ROUNDING_TOLERANCE` move a place 1,000 mm off by so much."""

IMAGE = "Image"
ORIENTATION = "OrientationSensor"
"""Name of the frame of an orientation sensor, which PLUS's devices do not use: its transform to World is a
rotation alone."""

Fields = Mapping[str, str]


@dataclass(frozen=True)
class Poses:
    """Poses of a tool in a header.

    Attributes
    ----------
    tool, world : str
        Names of their frames; the world is the reference's where one is tracked.
    names : tuple of str
        Of the tool's transform and the reference's, or "none", as they can be asked for.
    readings : TimedPoses
        Of the frames in which all of these are valid.
    pixels : ndarray, shape (4, 4), optional
        Where the tool is the image itself, whose transforms take pixels to mm: pixels to mm in the image.
    """

    tool: str
    world: str
    names: tuple[str, str]
    readings: TimedPoses
    pixels: FloatArray | None = None


def tracked_poses(
    path: str,
    frames: Sequence[Fields],
    tool: str | None,
    reference: str | None,
    usual: str = "ProbeToTracker",
    image: str = IMAGE,
) -> Poses | None:
    """Read the poses of a tool, seen from the reference if there is one.

    The tool may be the image itself, as in ``ImageToReference``: poses are then the nearest rigid ones.

    Parameters
    ----------
    tool, reference : str, optional
        Names of transforms, or ``"none"``; by default `usual` and that of ``Reference`` in the same world,
        where the frames hold them.
    image : str
        Name of the image's frame.

    Raises
    ------
    InvalidInputError
        If a transform that was asked for is not there, or none of it is valid.
    """
    sensor = _find(path, frames, tool, usual)
    if sensor is None:
        return None
    # Poses may be asked for by any name; a reference counts if both are tracked in the same world.
    moving, world = ends(sensor.name)
    fixed = _find(path, frames, reference, "none" if moving == "Reference" else f"ReferenceTo{world}")
    both = (sensor,) if fixed is None else (sensor, fixed)
    valid = valid_frames(frames, *(f"{one.held}TransformStatus" for one in both))
    if not valid.any():
        raise InvalidInputError(f"{path}: {sensor.held}TransformStatus: expected a valid one, got none")
    pixels = None
    if moving == image:
        poses, pixels = _poses_of_pixels(path, frames, sensor, valid)
    else:
        poses = _poses(path, frames, sensor, valid)
    if fixed is not None:
        poses = _poses(path, frames, fixed, valid).inv() * poses
        world = ends(fixed.name)[0]
    names = sensor.name, "none" if fixed is None else fixed.name
    return Poses(moving, world, names, TimedPoses(time_stamps(path, frames)[valid], poses[valid]), pixels)


def tracked_orientation(path: str, frames: Sequence[Fields]) -> TimedRotations | None:
    """Read the orientation sensor's stream that this package writes; None where there is none."""
    found = _find(path, frames, None, f"{ORIENTATION}ToWorld")
    if found is None:
        return None
    valid = valid_frames(frames, f"{found.held}TransformStatus")
    if not valid.any():
        return None
    turned = _poses(path, frames, found, valid)[valid].rotation
    return TimedRotations(time_stamps(path, frames)[valid], turned)


def time_stamps(path: str, frames: Sequence[Fields]) -> FloatArray:
    """Read the times of all frames, s.

    Raises
    ------
    InvalidInputError
        Naming the first that is missing or not after the one before.
    """
    where = f"{path}: Timestamp"
    times = [numbers(each.get("Timestamp", ""), 1, f"{where}[{i}]")[0] for i, each in enumerate(frames)]
    return require_increasing(times, where)


def fixed_transform(path: str, fields: Fields, frames: Sequence[Fields], name: str) -> FloatArray | None:
    """Read a transform that all frames share, or the whole file has; None where there is none.

    Raises
    ------
    InvalidInputError
        If frames differ.
    """
    key = f"{name}Transform"
    if key in fields:
        return np.reshape(numbers(fields[key], 16, f"{path}: {key}"), (4, 4))
    texts = {
        each[key]: i
        for i, each in reversed(list(enumerate(frames)))
        if key in each and each.get(f"{key}Status", "OK") == "OK"
    }
    if not texts:
        return None
    if len(texts) > 1:
        i = sorted(texts.values())[1]
        raise InvalidInputError(f"{path}: {key}[{i}]: expected that of the frames before, got another")
    ((text, i),) = texts.items()
    return np.reshape(numbers(text, 16, f"{path}: {key}[{i}]"), (4, 4))


def pixel_axes(matrix: FloatArray, where: str) -> tuple[float, float]:
    """Lengths of a column's and a row's step under a transform of pixels, mm.

    Raises
    ------
    InvalidInputError
        If the matrix is no such transform.
    """
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InvalidInputError(f"{where}: expected a finite 4x4 matrix, got shape {matrix.shape}")
    column, row = np.linalg.norm(matrix[:3, :2], axis=0).tolist()
    if not min(column, row) > 0:
        raise InvalidInputError(f"{where}: expected axes of some length, got zero")
    return column, row


def sensor_from_image(matrix: FloatArray, first_sample_depth_mm: float, where: str) -> RigidTransform:
    """Nearest rigid transform to a calibration of pixels, by singular values.

    Parameters
    ----------
    matrix : ndarray, shape (4, 4)
        Of pixels to mm; pixel (0, 0) is the first sample of the first vector.
    first_sample_depth_mm : float
        Depth of that sample, which lies so far along y from the origin of P.
    """
    axes = matrix[:3, :2] / pixel_axes(matrix, where)
    cosine = float(axes[:, 0] @ axes[:, 1])
    if abs(cosine) > SKEW_TOLERANCE:
        raise InvalidInputError(f"{where}: expected square axes, got cosine {cosine:.3f}")
    _require_right_handed(matrix[:3, :3], where)
    turned = nearest_rotation(axes)
    return RigidTransform.from_components(
        matrix[:3, 3] - turned[:, 1] * first_sample_depth_mm, Rotation.from_matrix(turned)
    )


def image_skew_rad(matrix: FloatArray, where: str) -> float:
    """Angle by which columns and rows of a calibration of pixels lean towards each other.

    The nearest rigid transform, `sensor_from_image`, lies in their middle: half of the angle is missing from
    either axis.
    """
    across, down = (matrix[:3, :2] / pixel_axes(matrix, where)).T
    return float(np.arcsin(across @ down))


def _require_right_handed(axes: FloatArray, where: str) -> None:
    """Refuse a mirrored calibration: a plane alone does not show it, its third column does.

    PLUS's calibrations write z = x cross y there [1]_; a column of zeros says nothing.

    References
    ----------
    .. [1] PLUS, vtkPlusProbeCalibrationAlgo.
    """
    lengths = np.linalg.norm(axes, axis=0)
    if lengths[2] == 0:
        return
    volume = float(np.linalg.det(axes / lengths))
    if volume < 0:
        raise InvalidInputError(
            f"{where}: expected right-handed axes (x to the marked side, y away from the probe, z = x cross "
            f"y), got mirrored ones (determinant {volume:.3g}): an axis has the wrong sign, or images were "
            "flipped before they were calibrated; if the third column was never measured, make it zeros"
        )


def image_matrix(
    sensor_from_image: RigidTransform,
    column_mm: float,
    row_mm: float,
    first_sample_depth_mm: float,
    skew_rad: float = 0.0,
) -> FloatArray:
    """Transform of pixels to mm that `sensor_from_image` and `image_skew_rad` read back, shape (4, 4).

    The third axis, of which a plane has no pixels, has the mean length, as in PLUS's own calibrations.
    """
    pixels = np.diag([column_mm, row_mm, (column_mm + row_mm) / 2, 1.0])
    half = skew_rad / 2
    pixels[:2, :2] = np.array([[np.cos(half), np.sin(half)], [np.sin(half), np.cos(half)]]) @ pixels[:2, :2]
    pixels[1, 3] = first_sample_depth_mm
    return np.asarray(sensor_from_image.as_matrix() @ pixels)


def ends(name: str) -> tuple[str, str]:
    """Split ``XToY`` as PLUS does, before a capital: ``ToolToTracker`` is of ``Tool`` in ``Tracker``."""
    found = re.fullmatch(r"(.+?)To([A-Z].*)", name)
    return (found[1], found[2]) if found else (name, "")


@dataclass(frozen=True)
class _Transform:
    """A tracked transform by the name asked for, and the one the header holds: that, or its inverse."""

    name: str
    held: str


def _find(path: str, frames: Sequence[Fields], given: str | None, default: str) -> _Transform | None:
    """Find ``XToY``, which takes points of X to Y, or ``YToX``, its inverse."""
    name = default if given is None else given.removesuffix("Transform")
    if name == "none":
        return None
    moving, world = ends(name)
    there = [
        held for held in (name, f"{world}To{moving}") if any(f"{held}Transform" in frame for frame in frames)
    ]
    if len(there) == 2 and IMAGE not in (moving, world):  # whose transforms count pixels
        _require_inverse(path, frames, *there)
    if there:
        return _Transform(name, there[0])
    if given is not None:
        known = ", ".join(names_of(frames)) or "none"
        raise InvalidInputError(f"{path}: expected a transform {name}, got {known}")
    return None


def _require_inverse(path: str, frames: Sequence[Fields], name: str, back: str) -> None:
    """Refuse poses that a header holds both ways round, where the two are not each other's inverses."""
    valid = valid_frames(frames, f"{name}TransformStatus", f"{back}TransformStatus")
    valid &= [f"{name}Transform" in each and f"{back}Transform" in each for each in frames]
    if not valid.any():
        return
    there, again = (_poses(path, frames, _Transform(held, held), valid)[valid] for held in (name, back))
    product = there * again
    off = np.flatnonzero(
        (product.rotation.magnitude() > ROUNDING_TOLERANCE)
        | (np.linalg.norm(product.translation, axis=-1) > _INVERSE_TOLERANCE_MM)
    )
    if off.size:
        i = int(np.flatnonzero(valid)[off[0]])
        raise InvalidInputError(
            f"{path}: {back}Transform[{i}]: expected the inverse of {name}Transform, got another: "
            "one of the two is wrong"
        )


def names_of(frames: Sequence[Fields]) -> list[str]:
    """Names of the transforms of any frame, as ``ProbeToTracker``."""
    names = {name for frame in frames for name in frame if name.endswith("Transform")}
    return sorted(name.removesuffix("Transform") for name in names)


def _poses(path: str, frames: Sequence[Fields], asked: _Transform, valid: BoolArray) -> RigidTransform:
    where = f"{path}: {asked.held}Transform"
    poses = transforms_from_matrices(_squared(_matrices(path, frames, asked, valid)), where)
    return poses if asked.held == asked.name else poses.inv()


def _matrices(path: str, frames: Sequence[Fields], asked: _Transform, valid: BoolArray) -> FloatArray:
    """Matrices as the header holds them, shape (n, 4, 4); the identity where they are not valid."""
    matrices = np.tile(np.eye(4), (len(frames), 1, 1))
    for i in np.flatnonzero(valid).tolist():
        text = frames[i].get(f"{asked.held}Transform", "")
        where = f"{path}: {asked.held}Transform[{i}]"
        matrices[i] = np.reshape(numbers(text, 16, where), (4, 4))
    return matrices


def _poses_of_pixels(
    path: str, frames: Sequence[Fields], asked: _Transform, valid: BoolArray
) -> tuple[RigidTransform, FloatArray]:
    """Split transforms of pixels to mm into the image's poses and its pixels, which are those of all frames.

    Raises
    ------
    InvalidInputError
        If a frame's pixels are of another size, or its axes are not about square.
    """
    matrices = _matrices(path, frames, asked, valid)
    if asked.held != asked.name:
        singular = valid & ~(np.abs(np.linalg.det(matrices)) > 0)
        if singular.any():
            i = int(np.argmax(singular))
            raise InvalidInputError(f"{path}: {asked.held}Transform[{i}]: expected a matrix to invert")
        matrices = np.asarray(np.linalg.inv(matrices), dtype=np.float64)
    names = [f"{path}: {asked.held}Transform[{i}]" for i in range(len(frames))]
    used = np.flatnonzero(valid).tolist()
    poses = [RigidTransform.identity() for _ in frames]
    sizes = np.zeros((len(frames), 3))
    for i in used:
        poses[i] = sensor_from_image(matrices[i], 0.0, names[i])
        sizes[i] = *pixel_axes(matrices[i], names[i]), 1.0 + image_skew_rad(matrices[i], names[i])
    mean = sizes[used].mean(axis=0)
    other = valid & (np.abs(sizes / mean - 1.0) > ROUNDING_TOLERANCE).any(axis=1)
    if other.any():
        i = int(np.argmax(other))
        shown = (f"{column:.6g} x {row:.6g} mm" for column, row, _ in (mean, sizes[i]))
        raise InvalidInputError("{}: expected pixels as of all frames, {}, got {}".format(names[i], *shown))
    column_mm, row_mm, leaning = mean.tolist()
    pixels = image_matrix(RigidTransform.identity(), column_mm, row_mm, 0.0, leaning - 1.0)
    return RigidTransform.concatenate(poses), pixels


def _squared(matrices: FloatArray) -> FloatArray:
    """Make rounded rotations exact; matrices farther off stay, for `transforms_from_matrices` to refuse."""
    r = matrices[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        rounded = np.abs(r.transpose(0, 2, 1) @ r - np.eye(3)).max(axis=(1, 2)) < ROUNDING_TOLERANCE
    rounded[rounded] = np.linalg.det(r[rounded]) > 0
    squared = matrices.copy()
    squared[rounded, :3, :3] = nearest_rotation(r[rounded])
    return squared
