"""Plane: whether errors lie within the standard errors claimed, with trackers that drift or not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.plane import calibrate_plane
from calibration.points import ImagePoints
from speckle3d.core.errors import InsufficientDataError

from .hand import misread, smooth
from .rows import Row, coverage_row, trials

DOWN = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""An image that looks straight down in a world whose z axis is up."""
COUNT = 150


@dataclass(frozen=True)
class Trial:
    """A scan to be drawn: its seed, whether the hand moves smoothly, and how the tracker errs.

    Attributes
    ----------
    white : (mm, degrees)
    drift : (mm, degrees, s)
    """

    seed: int
    smoothly: bool
    white: tuple[float, float] = (0.0, 0.0)
    drift: tuple[float, float, float] = (0.0, 0.0, 5.0)
    line_mm: float = 0.15


def scan(trial: Trial) -> tuple[ImagePoints, RigidTransform, np.ndarray]:
    """Lines of a floor that a hand scans, the true mounting, and the true pixel size."""
    rng = np.random.default_rng([trial.seed, 1997])
    count, rate = int(rng.integers(80, 260)), float(rng.uniform(5.0, 15.0))
    time_s = np.arange(count) / rate

    def over(reach: float) -> np.ndarray:
        return smooth(rng, time_s, reach) if trial.smoothly else rng.uniform(-reach, reach, count)

    width_mm, bottom_mm = rng.uniform(30.0, 60.0), rng.uniform(50.0, 120.0)
    pixel = rng.uniform(0.08, 0.3, 2)
    tilt, roll, yaw = (np.deg2rad(over(reach)) for reach in (25.0, 15.0, 60.0))
    axes = np.eye(3)
    turn = (
        Rotation.from_rotvec(np.outer(yaw, axes[2]))
        * DOWN
        * Rotation.from_rotvec(np.outer(roll, axes[2]))
        * Rotation.from_rotvec(np.outer(tilt, axes[0]))
    )
    up = turn.inv().apply(axes[2])
    depth = bottom_mm * (0.5 + over(0.3))
    # The line passes through (column, depth) of the image at its middle column.
    height = -(up[:, 0] * width_mm / 2.0 + up[:, 1] * depth)
    place = np.column_stack([over(60.0), over(60.0), height])
    mounting = RigidTransform.from_components(rng.uniform(-120.0, 120.0, 3), Rotation.random(rng=rng))
    floor = RigidTransform.from_components(
        rng.uniform(-300, 300, 3), Rotation.from_rotvec(np.deg2rad(rng.uniform(-20, 20, 3)))
    )
    poses = floor * RigidTransform.from_components(place, turn) * mounting.inv()
    ends = np.array([0.0, width_mm])
    rows = -(height[:, None] + up[:, :1] * ends) / up[:, 1:2]
    rows = rows + trial.line_mm * rng.standard_normal(rows.shape)
    pixels = np.stack([np.broadcast_to(ends / pixel[0], rows.shape), rows / pixel[1]], axis=-1)
    readings = misread(rng, poses, time_s, trial.white, trial.drift)
    return ImagePoints.of_lines(np.arange(count), pixels, readings, time_s), mounting, pixel


def judged(trial: Trial) -> np.ndarray | None:
    """Errors over claims of pose and pixel size in the image's frame, or None if refused."""
    points, mounting, pixel = scan(trial)
    try:
        solution = calibrate_plane(points)
    except InsufficientDataError:
        return None
    step = solution.chain.sensor_from_image.inv() * mounting
    errors = np.concatenate(
        [pixel - solution.chain.pixel_mm, step.translation, step.rotation.as_rotvec()[::-1]]
    )
    return errors / np.sqrt(np.diag(solution.covariance))[: len(errors)]


def measure(share: float, first_seed: int) -> list[Row]:
    """Coverage with white errors, and with drifting ones besides."""
    count = max(4, round(COUNT * share))
    rows = []
    white = (0.15, 0.1)
    for case, drift in (("white noise", (0.0, 0.0, 5.0)), ("drift 0.3 mm, 0.2 deg, 5 s", (0.3, 0.2, 5.0))):
        for smoothly in (True, False):
            todo = [Trial(first_seed + n, smoothly, white, drift) for n in range(count)]
            found = trials(judged, todo)
            scores = np.array([one for one in found if one is not None])
            moved = "smooth motion" if smoothly else "frames at random poses"
            row = coverage_row(f"plane, {case}, {moved}", scores, np.ones_like(scores))
            refused = sum(one is None for one in found)
            rows.append(Row(row.case, f"{row.found}, {refused} refused", row.target, row.reached))
    return rows
