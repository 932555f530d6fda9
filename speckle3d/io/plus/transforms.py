"""Transforms of PLUS by frame: poses of a tracked tool, and where the image is on it.

``XToY`` takes points of X to Y, in mm; ``Image`` counts pixels of the image turned to columns and rows.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.geometry import nearest_rotation
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

_FIXED_TOLERANCE = 1e-4
"""How far entries of a transform that all frames share may differ: six written digits of tens of mm."""

IMAGE = "Image"
ORIENTATION = "OrientationSensor"
"""Name of the frame of an orientation sensor, which PLUS's devices do not use: its transform to World is a
rotation alone."""

Fields = Mapping[str, str]


@dataclass(frozen=True)
class Poses:
    """Poses of a tool in the frames of a header.

    Attributes
    ----------
    tool : str
        Name of its frame.
    chain : tuple of str
        Transforms from the tool to the world, in the order in which they are applied.
    poses : RigidTransform, length n
        The identity where not valid.
    valid : ndarray of bool, shape (n,)
    reasons : Counter
        How many are not valid, by why.
    pixels : ndarray, shape (4, 4), optional
        Where the tool is the image itself, whose transforms take pixels to mm: pixels to mm in the image.
    """

    tool: str
    chain: tuple[str, ...]
    poses: RigidTransform
    valid: BoolArray
    reasons: Counter[str]
    pixels: FloatArray | None = None


@dataclass(frozen=True)
class Names:
    """Names of coordinate frames, by default PLUS's own."""

    image: str = IMAGE
    probe: str = "Probe"
    tracker: str = "Tracker"


def tracked_poses(
    path: str, frames: Sequence[Fields], asked: str | None, reference: str | None, names: Names
) -> Poses | None:
    """Read the poses of a tool, seen from the reference if there is one.

    The tool may be the image itself, as in ``ImageToReference``: poses are then the nearest rigid ones.

    Parameters
    ----------
    asked, reference : str, optional
        Names of transforms, or ``"none"``; by default the probe's, in the tracker or in the only frame that
        it is tracked in, else the image's; and that of ``Reference`` in the same world.

    Returns
    -------
    Poses or None
        None where the frames hold none, or none by these names.

    Raises
    ------
    InvalidInputError
        If a transform that was asked for is not there.
    """
    there = names_of(frames)
    name = _usual(there, names) if asked is None else asked.removesuffix("Transform")
    if name is None or name == "none":
        return None
    tool, world = ends(name)
    held = [_held(path, there, name, is_asked=asked is not None)]
    # A reference counts if both are tracked in the same world.
    fixed = f"ReferenceTo{world}" if reference is None else reference.removesuffix("Transform")
    if tool == "Reference" and reference is None:
        fixed = "none"
    if fixed != "none" and (reference is not None or _either(there, fixed)):
        held.append(_held(path, there, fixed, is_asked=reference is not None))
    columns = [_Column.read(path, frames, each) for each in held if each is not None]
    if not columns:
        return None
    pixels = None
    if tool == names.image:
        first, pixels = _poses_of_pixels(path, name, columns[0])
    else:
        first = columns[0].rigid()
        _require_inverse(path, frames, there, name)
    columns = [first, *(column.rigid() for column in columns[1:])]
    valid = np.logical_and.reduce([column.valid for column in columns])
    reasons: Counter[str] = Counter()
    for i in np.flatnonzero(~valid):
        reasons[next(column.reasons[i] for column in columns if not column.valid[i])] += 1
    matrices = columns[0].matrices
    chain = [name]
    if len(columns) > 1:
        matrices = np.asarray(np.linalg.inv(columns[1].matrices) @ matrices)
        chain.append("To".join(reversed(ends(fixed))))
    poses = RigidTransform.from_matrix(np.where(valid[:, None, None], matrices, np.eye(4)))
    return Poses(tool, tuple(chain), poses, valid, reasons, pixels)


def tracked_orientation(path: str, frames: Sequence[Fields]) -> Poses | None:
    """Read the orientation sensor's stream that this package writes; None where there is none."""
    name = f"{ORIENTATION}ToWorld"
    if name not in names_of(frames):
        return None
    return tracked_poses(path, frames, name, "none", Names())


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
    column = _Column.read(path, frames, (name, False))
    if not column.valid.any():
        return None
    matrices = column.matrices[column.valid]
    off = np.abs(matrices - np.median(matrices, axis=0)).max(axis=(1, 2))
    if off.max() > _FIXED_TOLERANCE * max(1.0, np.abs(matrices).max()):
        i = int(np.flatnonzero(column.valid)[np.argmax(off)])
        raise InvalidInputError(f"{path}: {key}[{i}]: expected that of the other frames, got another")
    first: FloatArray = matrices[0]
    return first


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
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    # PLUS writes z = x cross y as the third column (vtkPlusProbeCalibrationAlgo); zeros say nothing.
    volume = float(np.linalg.det(matrix[:3, :3] / lengths)) if lengths[2] else 1.0
    if volume < 0:
        raise InvalidInputError(
            f"{where}: expected right-handed axes (x to the marked side, y away from the probe, z = x cross "
            f"y), got mirrored ones (determinant {volume:.3g}): an axis has the wrong sign, or images were "
            "flipped before they were calibrated; if the third column was never measured, make it zeros"
        )
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
    parts = re.fullmatch(r"(.+?)To([A-Z].*)", name)
    return (parts[1], parts[2]) if parts else (name, "")


def names_of(frames: Sequence[Fields]) -> list[str]:
    """Names of the transforms of any frame, as ``ProbeToTracker``."""
    names = {name for frame in frames for name in frame if name.endswith("Transform")}
    return sorted(name.removesuffix("Transform") for name in names)


def _usual(there: Sequence[str], names: Names) -> str | None:
    """The probe's pose, else the image's, in the tracker, or in the only frame where it is tracked."""
    if _either(there, f"{names.probe}To{names.tracker}"):
        return f"{names.probe}To{names.tracker}"
    for tool in (names.probe, names.image):
        worlds = {b if a == tool else a for a, b in map(ends, there) if tool in (a, b)}
        worlds -= {names.probe, names.image, "TransducerOrigin", "TransducerOriginPixel", ""}
        if names.tracker in worlds:
            return f"{tool}To{names.tracker}"
        if "Reference" in worlds or len(worlds) == 1:
            return f"{tool}To{'Reference' if 'Reference' in worlds else worlds.pop()}"
    return None


def _either(there: Sequence[str], name: str) -> bool:
    return name in there or "To".join(reversed(ends(name))) in there


def _held(path: str, there: Sequence[str], name: str, is_asked: bool) -> tuple[str, bool] | None:
    """The transform that the frames hold, ``XToY`` or its inverse ``YToX``, and whether it is that."""
    back = "To".join(reversed(ends(name)))
    if name in there:
        return name, False
    if back in there:
        return back, True
    if is_asked:
        raise InvalidInputError(f"{path}: expected a transform {name}, got {', '.join(there) or 'none'}")
    return None


def _require_inverse(path: str, frames: Sequence[Fields], there: Sequence[str], name: str) -> None:
    """Refuse poses that a header holds both ways round, where the two are not each other's inverses."""
    back = "To".join(reversed(ends(name)))
    if name not in there or back not in there:
        return
    one, other = (_Column.read(path, frames, (held, False)).rigid() for held in (name, back))
    valid = one.valid & other.valid
    if not valid.any():
        return
    product = RigidTransform.from_matrix((one.matrices @ other.matrices)[valid])
    far = (product.rotation.magnitude() > ROUNDING_TOLERANCE) | (
        np.linalg.norm(product.translation, axis=-1) > _INVERSE_TOLERANCE_MM
    )
    if far.any():
        i = int(np.flatnonzero(valid)[np.argmax(far)])
        raise InvalidInputError(
            f"{path}: {back}Transform[{i}]: expected the inverse of {name}Transform, got another: "
            "one of the two is wrong"
        )


@dataclass(frozen=True)
class _Column:
    """One transform by frame: matrices, the identity where not valid, and why those are not."""

    matrices: FloatArray
    valid: BoolArray
    reasons: list[str]

    @classmethod
    def read(cls, path: str, frames: Sequence[Fields], held: tuple[str, bool]) -> _Column:
        """Read a transform, or the inverse of the one that is held."""
        name, is_inverse = held
        matrices = np.tile(np.eye(4), (len(frames), 1, 1))
        reasons = [""] * len(frames)
        for i, frame in enumerate(frames):
            text = frame.get(f"{name}Transform")
            if text is None or frame.get(f"{name}TransformStatus", "OK") != "OK":
                reasons[i] = "without a valid pose"
                continue
            try:
                matrices[i] = np.reshape(numbers(text, 16, path), (4, 4))
            except InvalidInputError:
                reasons[i] = "whose pose is not 16 finite numbers"
        if is_inverse:
            for i in np.flatnonzero(~(np.abs(np.linalg.det(matrices)) > 0)).tolist():
                matrices[i], reasons[i] = np.eye(4), "whose pose has no inverse"
            matrices = np.asarray(np.linalg.inv(matrices), dtype=np.float64)
        return cls(matrices, np.array([not reason for reason in reasons], dtype=bool), reasons)

    def rigid(self) -> _Column:
        """Make rounded rotations exact; a matrix farther off is not valid."""
        r = self.matrices[:, :3, :3]
        with np.errstate(over="ignore", invalid="ignore"):
            near = np.abs(r.transpose(0, 2, 1) @ r - np.eye(3)).max(axis=(1, 2)) < ROUNDING_TOLERANCE
            near &= np.abs(self.matrices[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) < ROUNDING_TOLERANCE
        near[near] = np.linalg.det(r[near]) > 0
        matrices = np.tile(np.eye(4), (len(r), 1, 1))
        matrices[near, :3, 3] = self.matrices[near, :3, 3]
        matrices[near, :3, :3] = nearest_rotation(r[near])
        reasons = [reason or ("" if ok else "whose pose is not rigid") for reason, ok in
                   zip(self.reasons, near, strict=True)]  # fmt: skip
        return _Column(matrices, self.valid & near, reasons)


def _poses_of_pixels(path: str, name: str, column: _Column) -> tuple[_Column, FloatArray | None]:
    """Split transforms of pixels to mm into the image's poses and its pixels, the same in all frames."""
    matrices, valid, reasons = column.matrices, column.valid.copy(), list(column.reasons)
    rigid = np.tile(np.eye(4), (len(matrices), 1, 1))
    sizes = np.ones((len(matrices), 3))
    fault: InvalidInputError | None = None
    for i in np.flatnonzero(valid).tolist():
        where = f"{path}: {name}Transform[{i}]"
        try:
            rigid[i] = sensor_from_image(matrices[i], 0.0, where).as_matrix()
            sizes[i] = *pixel_axes(matrices[i], where), 1.0 + image_skew_rad(matrices[i], where)
        except InvalidInputError as error:
            fault, valid[i], reasons[i] = fault or error, False, "whose pixels make no sense"
    if not valid.any():
        if fault is not None:
            raise fault
        return _Column(rigid, valid, reasons), None
    middle = np.median(sizes[valid], axis=0)
    other = valid & (np.abs(sizes / middle - 1.0) > ROUNDING_TOLERANCE).any(axis=1)
    for i in np.flatnonzero(other).tolist():
        valid[i], reasons[i] = False, f"whose pixels are not of {middle[0]:.6g} x {middle[1]:.6g} mm"
    column_mm, row_mm, leaning = sizes[valid].mean(axis=0).tolist()
    pixels = image_matrix(RigidTransform.identity(), column_mm, row_mm, 0.0, leaning - 1.0)
    return _Column(rigid, valid, reasons), pixels
