"""Calibration of an orientation sensor from lines of a plane: the plane module's first stage, and gravity.

References
----------
.. [1] R. J. Housden et al., "Calibration of an orientation sensor for freehand 3D ultrasound and its use in a
   hybrid acquisition system", BioMedical Engineering OnLine, 2008, "Calibrating the MT9-B position sensor".
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.alternatives import best_solution
from calibration.chain import ANGLES, ChainSolution, ImagePoints
from calibration.identifiability import require_adequate
from calibration.plane import LineDirections, settled_angles
from calibration.solver import OUTLIER_SIGMA, SOME_FRAMES
from calibration.starts import hemisphere, in_plane_mirror
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError

Viewed = Literal["above", "below"]

FEWEST_LINES = 6

MIRROR_LIMIT = 0.2
"""Mean vertical component of the beam direction below which gravity cannot tell the image from its mirror:
below 12 degrees from level, on average, the hand and the floor may be tilted as much."""

_CERTAIN_RAD = np.deg2rad(5.0)

STEEPEST_PLANE = np.deg2rad(45.0)
"""A plane steeper than this is not a floor: the world's z axis is not up, or the lines are others."""


def calibrate_orientation(
    directions_px: FloatArray,
    frame: IntArray,
    world_from_sensor: Rotation,
    pixel_mm: FloatArray,
    level: bool = False,
    viewed_from: Viewed = "above",
    outlier_sigma: float = OUTLIER_SIGMA,
    time_s: FloatArray | None = None,
) -> ChainSolution:
    """Calibrate an orientation sensor: find the rotation ``sensor_from_image`` from lines of a plane.

    Parameters
    ----------
    directions_px : ndarray, shape (m, 2)
        Columns and rows from one point of the plane's line to another.
    frame : ndarray of int, shape (m,)
    world_from_sensor : Rotation, length m
        With the world's z axis up. If the plane is level, the heading may be wrong.
    pixel_mm : ndarray, shape (2,)
        Column pitch and row spacing; only their ratio matters.
    level : bool
        The plane is level: three unknowns instead of five.
    viewed_from : str
        ``"above"``: on average the beam points down, as over the floor of a water bath; ``"below"``: up. It
        tells the image from its in-plane mirror, which the lines alone cannot.
    time_s : ndarray, shape (m,), optional
        Of each line; without it, frames are taken to be evenly spaced.

    Raises
    ------
    InsufficientDataError
        If there are too few lines; they contradict each other; gravity cannot tell the image from its
        mirror; or the motion does not determine the answer, and then the missing motion is named.
    """
    if len(directions_px) < FEWEST_LINES:
        raise InsufficientDataError(f"expected lines in at least {FEWEST_LINES} frames, got {len(frame)}")
    if viewed_from not in ("above", "below"):
        raise InvalidInputError(f"viewed_from: expected 'above' or 'below', got {viewed_from!r}")
    size = np.array([float(pixel_mm[0] / pixel_mm[1]), 1.0])
    normals = hemisphere()
    normals = normals[:1] if level else normals[normals[:, 2] > np.cos(STEEPEST_PLANE)]
    lines = ImagePoints(directions_px, frame, RigidTransform.from_rotation(world_from_sensor), time_s=time_s)
    starts = settled_angles(lines.of_some_frames(SOME_FRAMES), size[0], normals, level=level)
    found = best_solution(lines, LineDirections(size, level), starts, ANGLES, outlier_sigma)
    best = require_adequate(found)
    _require_floor(best)
    return upright(best, viewed_from)


def upright(solution: ChainSolution, viewed_from: Viewed = "above") -> ChainSolution:
    """Of a solution and its in-plane mirror, choose the one whose beams point down (up, if from below).

    Raises
    ------
    InsufficientDataError
        If the beams are level on average.
    """
    used = solution.points_used.world_from_sensor.rotation
    beams = (used * solution.chain.sensor_from_image.rotation).as_matrix()[:, :, 1]
    down = -float(beams[:, 2].mean())
    if abs(down) < MIRROR_LIMIT:
        raise InsufficientDataError(
            f"expected beams that point down on average, got {np.rad2deg(np.arcsin(down)):.0f} degrees "
            "below level: gravity cannot tell the image from its mirror; scan a level plane from above, or "
            "say it is seen from below"
        )
    if (down > 0) == (viewed_from == "above"):
        return solution
    mirror = in_plane_mirror(solution.chain.sensor_from_image.rotation)
    chain = replace(solution.chain, sensor_from_image=RigidTransform.from_rotation(mirror))
    return replace(solution, chain=chain, residuals=-solution.residuals)


def _require_floor(solution: ChainSolution) -> None:
    """Refuse a plane that is certainly not a floor; `judge` names what leaves one undetermined."""
    certain = np.diag(solution.image_covariance(("beta_c", "gamma_c"))).max() < _CERTAIN_RAD**2
    slope = float(np.arccos(min(abs(solution.chain.target_from_world.rotation.as_matrix()[2, 2]), 1.0)))
    if certain and slope > STEEPEST_PLANE:
        raise InsufficientDataError(
            f"expected a plane within {np.rad2deg(STEEPEST_PLANE):.0f} degrees of level, got one at "
            f"{np.rad2deg(slope):.0f}: is the world's z axis up, and are the lines those of the floor?"
        )
