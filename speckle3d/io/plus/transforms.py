"""Transforms of PLUS by frame: poses of a tracked tool, and where the image is on it.

``XToY`` takes points of X to Y, in mm; ``Image`` counts pixels of the image turned to columns and rows.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.geometry import nearest_rotation
from speckle3d.core.grid import ImageGrid
from speckle3d.io.images.headers import SequenceHeader
from speckle3d.io.text import numbers

Pair = tuple[str, str]
"""Frames from which and to which a transform leads."""

SKEW_TOLERANCE = 0.1
"""How far the axes of a measured image calibration may be from square, as the cosine of their angle. PLUS's
published calibrations reach 0.05, an error of the calibration and not of the image."""

_FIXED_TOLERANCE = 1e-4
"""How far entries of a transform that all frames share may differ, mm and share: six written digits."""

IMAGE = "Image"
ORIENTATION = "OrientationSensor"
"""Name of the frame of an orientation sensor, which PLUS's devices do not use: its transform to World is a
rotation alone."""
PROBE, _REFERENCE = "Probe", "Reference"
_WORLDS = ("Tracker", _REFERENCE)


@dataclass(frozen=True)
class Poses:
    """Poses of a tool in the frames of a header.

    Attributes
    ----------
    tool : str
        Name of its frame.
    chain : tuple of str
        Transforms from the tool to the world, in the order in which they are applied.
    matrices : ndarray, shape (n, 4, 4)
        Rigid to rounding; NaN where there is no valid one.
    pixels : ndarray, shape (4, 4), optional
        Where the tool is the image itself, whose transforms take pixels to mm: pixels to mm in the image.
    """

    tool: str
    chain: tuple[str, ...]
    matrices: FloatArray
    pixels: FloatArray | None = None


def tracked_poses(
    header: SequenceHeader,
    tool_pose: str | None,
    reference: str | None,
    image: str = IMAGE,
    probe: str = PROBE,
    fixed: Sequence[Pair] = (),
) -> Poses | None:
    """Read the poses of a tool, seen from the reference if there is one.

    The tool may be the image itself, as in ``ImageToReference``.

    Parameters
    ----------
    tool_pose, reference : str, optional
        Names of transforms, or ``"none"``; by default the probe's, in the tracker or in the only frame that
        it is tracked in, else that of what the image is on, else the image's; and that of ``Reference`` where
        a chain leads there.
    image, probe : str
        Names of the image's and the probe's frame.
    fixed : sequence of pair
        Transforms of a device set, which may say what the image is on.

    Returns
    -------
    Poses or None
        None where the frames hold none, or none by these names.

    Raises
    ------
    InvalidInputError
        If a transform that was asked for is not there.
    """
    transforms = names_of(header)
    pairs = [ends(name) for name in transforms]
    usual = _usual_pose(pairs, fixed, image, probe) if tool_pose is None else tool_pose
    name = usual and usual.removesuffix("Transform")
    if name is None or name == "none":
        return None
    tool, world = ends(name)
    # A tool's poses do not lead by way of the image, whose transforms take pixels to mm.
    pairs = [pair for pair in pairs if tool == image or image not in pair]
    chain, target = chain_between(pairs, tool, world), _REFERENCE if reference is None else ends(reference)[0]
    if chain and target not in (tool, "none"):
        chain = chain_between(pairs, tool, target) or (chain if reference is None else None)
    if not chain:
        wanted = " and ".join(filter(None, (name, reference)))
        listing = ", ".join(transforms) or "none"
        raise InvalidInputError(f"{header.path}: expected a chain of transforms for {wanted}, got {listing}")
    matrices, pixels = np.eye(4), None
    for pair in chain:
        matrices = _column(header, *pair) @ matrices
    widths = np.linalg.norm(matrices[:, :3, 0], axis=1)
    count = np.count_nonzero(np.isfinite(widths))
    if tool == image and count:
        where, usual = f"{header.path}: {name}Transform", matrices[np.argsort(widths)[count // 2]]
        _, skew_rad = sensor_from_image(usual, 0.0, where)  # refuses what is no calibration
        pixels = pixel_matrix(ImageGrid(1, 1, *pixel_axes(usual, where), skew_rad=skew_rad))
        for pose in (matrices, pixels):  # a third column may be anything
            pose[..., :3, 2] = np.cross(pose[..., :3, 0], pose[..., :3, 1])
        # Where a frame's pixels are others, its pose is not rigid.
        matrices = matrices @ np.linalg.inv(pixels)
    return Poses(tool, tuple(map(_joined, chain)), matrices, pixels)


def chain_between(pairs: Iterable[Pair], start: str, end: str) -> list[Pair] | None:
    """Fewest steps between two frames, along transforms or against them; None if there is no way."""
    steps = [step for a, b in pairs for step in ((a, b), (b, a))]
    chains, queue = {start: list[Pair]()}, [start]
    for frame in queue:
        for a, b in steps:
            if a == frame and b not in chains:
                chains[b] = [*chains[a], (a, b)]
                queue.append(b)
    return chains.get(end)


def fixed_transform(header: SequenceHeader, name: str) -> FloatArray | None:
    """Read a transform that all frames share, or the whole file has; None where there is none.

    Raises
    ------
    InvalidInputError
        If frames differ.
    """
    key = f"{name}Transform"
    if key in header.fields:
        return np.reshape(numbers(header.fields[key], 16, f"{header.path}: {key}"), (4, 4))
    matrices = _column(header, *ends(name))
    matrices = matrices[np.isfinite(matrices[:, 0, 0])]
    if not np.allclose(matrices, matrices[:1], _FIXED_TOLERANCE, _FIXED_TOLERANCE):
        raise InvalidInputError(f"{header.path}: {key}: expected one for all frames, got others")
    return next(iter(matrices), None)


def pixel_axes(matrix: FloatArray, where: str) -> tuple[float, float]:
    """Lengths of a column's and a row's step under a transform of pixels, mm.

    Raises
    ------
    InvalidInputError
        If the matrix is no such transform.
    """
    column, row = np.linalg.norm(matrix[:3, :2], axis=0).tolist()
    if not min(column, row) > 0:
        raise InvalidInputError(f"{where}: expected axes of some length, got zero")
    return column, row


def sensor_from_image(
    matrix: FloatArray, first_sample_depth_mm: float, where: str
) -> tuple[RigidTransform, float]:
    """Nearest rigid transform to a calibration of pixels, and how far its axes lean.

    Columns and rows lean towards each other by that angle, rad; the transform lies in their middle: half of
    the angle is missing from either axis.

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
    # PLUS writes z = x cross y as the third column (vtkPlusProbeCalibrationAlgo); zeros say nothing.
    if np.linalg.det(matrix[:3, :3]) < 0:
        raise InvalidInputError(
            f"{where}: expected right-handed axes (x to the marked side, y away from the probe, z = x cross "
            "y), got mirrored ones: an axis has the wrong sign, or images were flipped before they were "
            "calibrated; if the third column was never measured, make it zeros"
        )
    rotation = nearest_rotation(axes)
    place = matrix[:3, 3] - rotation[:, 1] * first_sample_depth_mm
    return RigidTransform.from_components(place, Rotation.from_matrix(rotation)), float(np.arcsin(cosine))


def pixel_matrix(grid: ImageGrid) -> FloatArray:
    """Transform of an image's pixels to mm in it, shape (4, 4).

    The third axis, of which a plane has no pixels, has the mean length, as in PLUS's own calibrations.
    """
    slice_mm = (grid.vector_pitch_mm + grid.sample_spacing_mm) / 2
    return np.insert(grid.image_from_sample, 2, [0.0, 0.0, slice_mm, 0.0], axis=1)


def ends(name: str) -> tuple[str, str]:
    """Split ``XToY`` as PLUS does, before a capital: ``ToolToTracker`` is of ``Tool`` in ``Tracker``."""
    parts = re.fullmatch(r"(.+?)To([A-Z].*)", name)
    return (parts[1], parts[2]) if parts else (name, "")


def names_of(header: SequenceHeader) -> list[str]:
    """Names of the transforms of any frame, as ``ProbeToTracker``; one of a frame to itself says nothing."""
    fields = {name for frame in header.frames.values() for name in frame if name.endswith("Transform")}
    names = sorted(name.removesuffix("Transform") for name in fields)
    return [name for name in names if len({*ends(name)}) > 1]


def _joined(pair: tuple[str, str]) -> str:
    """Name of the transform between two frames, or of one that names no world."""
    return "To".join(filter(None, pair))


def _usual_pose(pairs: Sequence[Pair], fixed: Sequence[Pair], image: str, probe: str) -> str | None:
    """Choose the pose of the probe, of what the image is on, or of the image, in the usual or only world."""

    def partners(tool: str, pairs: Sequence[Pair]) -> set[str]:
        frames = {b if a == tool else a for a, b in pairs if tool in (a, b)}
        return frames - {probe, image, "TransducerOrigin", "TransducerOriginPixel", ""}

    carriers = sorted(partners(image, [*pairs, *fixed]) - {*_WORLDS})
    for tool in (probe, *carriers, image):
        worlds = partners(tool, pairs)
        for world in (*_WORLDS, *(worlds if len(worlds) == 1 else ())):
            if world in worlds:
                return f"{tool}To{world}"
    return None


def _column(header: SequenceHeader, start: str, end: str) -> FloatArray:
    """Read one transform of every frame, either way round, shape (n, 4, 4); NaN where it is not valid."""
    keys = [f"{_joined(pair)}Transform" for pair in ((start, end), (end, start))]
    is_back = not header.column(keys[0])
    matrices = header.values(keys[is_back], 16).reshape(-1, 4, 4)
    for i, status in header.column(f"{keys[is_back]}Status").items():
        matrices[i] *= 1.0 if status == "OK" else np.nan
    if is_back:
        is_valid = np.isfinite(matrices[:, 0, 0])
        matrices[is_valid] = np.linalg.pinv(matrices[is_valid])
    return matrices
