"""Ways to move a probe over a phantom: which of them a scan has, and frames that show one more."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.chain import ChainSolution, ImagePoints
from speckle3d.core.arrays import FloatArray

_TURN_RAD = np.deg2rad(15.0)
_SHIFT = 0.2
"""Imagined frames are turned by as much, and shifted by as much of the image, to either side."""
_LEAST_SHIFT_MM = 8.0
"""And by as much at least, even of a small image: a hand wobbles by millimetres whatever the image's size."""
_OBLONG = 3.0
"""Pixels found to be so oblong, or more, are taken for square: their shape was not determined."""
_ABSENT = 0.25
"""A motion whose standard deviation is below this share of that step is absent: a hand that means to hold
still wobbles by a degree or two, 0.7 to 1.4 as a standard deviation; one that moves on purpose moves by five.
"""


@dataclass(frozen=True)
class Motion:
    """A way to move the probe: turn about, or shift along, one of the image's axes."""

    advice: str
    axis: int
    turns: bool


TILT = Motion("tilt the probe to and fro (rotate about the image's lateral axis)", 0, True)
YAW = Motion("rotate about the beam axis", 1, True)
ROLL = Motion("roll the probe from side to side (rotate about the elevational axis)", 2, True)
SIDEWAYS = Motion("shift the probe sideways (the phantom then appears elsewhere across the image)", 0, False)
UP_AND_DOWN = Motion("move the probe up and down (the phantom then appears at other depths)", 1, False)
MOTIONS = (TILT, YAW, ROLL, SIDEWAYS, UP_AND_DOWN)


def on_phantom(solution: ChainSolution, points: ImagePoints) -> ImagePoints:
    """Points whose sensor is at the image and whose world is the phantom: all angles to be found are zero."""
    return replace(points, world_from_sensor=solution.chain.target_from_image(points))


def image_mm(solution: ChainSolution) -> FloatArray:
    """Width and depth of the image as far as the phantom was seen in it, mm."""
    return np.asarray(solution.points_used.pixels.max(axis=0) * solution.chain.pixel_mm)


def extents(solution: ChainSolution) -> dict[Motion, float]:
    """How much of each motion a scan has: standard deviation over that of the imagined frames.

    Lines tell roll and depth by themselves, and the sensor alone tells how far the plane's normal moved in
    its frame: the mounting, which is not known well where a motion is missing, hardly enters. Motions that
    cannot help are left out: a plane looks the same from every side.
    """
    points, size = solution.points_used, solution.chain.pixel_mm
    if solution.phantom.seen_as == "dot":
        turns = solution.chain.target_from_image(points).rotation
        spread = (turns.mean().inv() * turns).as_rotvec().std(axis=0) / _TURN_RAD
        places = (points.pixels * size).std(axis=0) / _steps_mm(solution)
        return dict(zip(MOTIONS, [*spread, *places], strict=True))
    up = points.turns.transpose(0, 2, 1) @ solution.chain.target_from_world.rotation.as_matrix()[2]
    middle = up.mean(axis=0) / np.linalg.norm(up.mean(axis=0))
    swing = float(np.sum((up - np.outer(up @ middle, middle)).var(axis=0)))
    if not 1.0 / _OBLONG < size[0] / size[1] < _OBLONG:
        size = np.full(2, size[1])
    if solution.angular:
        along, depth = points.pixels * size, None
    else:
        ends = (points.pixels * size).reshape(-1, 2, 2)
        along, centre = ends[:, 1] - ends[:, 0], ends.mean(axis=1)
        depth = centre[:, 1] + (_middle_column(centre) - centre[:, 0]) * along[:, 1] / along[:, 0]
    slope = np.arctan(along[:, 1] / along[:, 0])
    found = {
        TILT: np.sqrt(max(swing - slope.var(), 0.0)) / _TURN_RAD,
        # The slope depends on the pixels' shape, which may be wrong; the normal swings as far at least.
        ROLL: min(slope.std(), np.sqrt(swing)) / _TURN_RAD,
    }
    if depth is not None:
        # About the column at which the lines cross: turning the probe there does not change the depth.
        steps = np.column_stack([np.ones(len(slope)), np.tan(slope)])
        left = depth - steps @ np.linalg.lstsq(steps, depth, rcond=None)[0]
        found[UP_AND_DOWN] = left.std() / _steps_mm(solution)[1]
    return {motion: float(extent) for motion, extent in found.items()}


def _steps_mm(solution: ChainSolution) -> FloatArray:
    return np.maximum(_SHIFT * image_mm(solution), _LEAST_SHIFT_MM)


def _middle_column(centre_mm: FloatArray) -> float:
    return float(np.median(centre_mm[:, 0]))


def absent(solution: ChainSolution) -> list[Motion]:
    """Motions that a scan has not."""
    return [motion for motion, extent in extents(solution).items() if extent < _ABSENT]


def with_motion(solution: ChainSolution, near: ImagePoints, motion: Motion) -> ImagePoints:
    """Frames of a scan with the probe moved in one more way to both sides, without noise."""
    moved = _turned if motion.turns else _shifted
    steps = [moved(solution, near, np.eye(3)[motion.axis] * sign) for sign in (-1.0, 1.0)]
    frame = np.concatenate([step.frame for step in steps])
    poses = RigidTransform.concatenate([step.world_from_sensor for step in steps])
    wire = None if near.wire is None else np.tile(near.wire, 2)
    return ImagePoints(np.concatenate([step.pixels for step in steps]), frame, poses, wire)


def _shifted(solution: ChainSolution, near: ImagePoints, axis: FloatArray) -> ImagePoints:
    """The image shifted along itself, so that the same points of the phantom appear elsewhere in it."""
    step = axis * np.append(_steps_mm(solution), 0.0)
    shift = RigidTransform.from_translation(step)
    pixels = near.pixels - step[:2] / solution.chain.pixel_mm
    return replace(near, pixels=pixels, world_from_sensor=near.world_from_sensor * shift)


def _turned(solution: ChainSolution, near: ImagePoints, axis: FloatArray) -> ImagePoints:
    """The image turned about its dot, or about the middle of its line, which then runs elsewhere."""
    turn = Rotation.from_rotvec(_TURN_RAD * axis)
    seen, size = solution.phantom.seen_as, solution.chain.pixel_mm
    if seen == "dot":
        return _about(near, near.pixels * size, turn, near.pixels)
    up = near.turns[:, 2] @ turn.as_matrix()
    along = np.column_stack([-up[:, 1], up[:, 0]])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    if seen == "direction":
        return _about(near, np.zeros_like(near.pixels), turn, along / size)
    ends = (near.pixels * size).reshape(-1, 2, 2)
    middle = np.repeat(ends.mean(axis=1), 2, axis=0)
    half = np.repeat(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / 2.0, 2)
    sign = np.tile([-1.0, 1.0], len(ends))
    return _about(near, middle, turn, (middle + (sign * half)[:, None] * along) / size)


def _about(near: ImagePoints, centre_mm: FloatArray, turn: Rotation, pixels: FloatArray) -> ImagePoints:
    centre = np.column_stack([centre_mm, np.zeros(len(centre_mm))])
    step = RigidTransform.from_components(centre - turn.apply(centre), turn)
    return replace(near, pixels=pixels, world_from_sensor=near.world_from_sensor * step)
