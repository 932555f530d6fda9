"""Calibration of an orientation sensor from lines of a plane: the plane module's first stage, and gravity.

References
----------
.. [1] R. J. Housden et al., "Calibration of an orientation sensor for freehand 3D ultrasound and its use in a
   hybrid acquisition system", BioMedical Engineering OnLine, 2008, "Calibrating the MT9-B position sensor".
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.motion import require_adequate
from calibration.plane import angle_starts, hemisphere, line_directions
from calibration.points import ANGLES, SOME_FRAMES, ImagePoints, as_directions
from calibration.settings import OrientationFit
from calibration.solution import Problem, Solution
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError

MIRROR_LIMIT = 0.2
"""Mean vertical component of the beam direction below which gravity cannot tell the image from its mirror:
below 12 degrees from level, on average, the hand and the floor may be tilted as much."""

STEEPEST_PLANE = np.deg2rad(45.0)
"""A plane steeper than this is not a floor: the world's z axis is not up, or the lines are others."""
_CERTAIN_RAD = np.deg2rad(5.0)


def calibrate_orientation(
    lines: ImagePoints, pixel_mm: FloatArray, settings: OrientationFit | None = None
) -> Solution:
    """Calibrate an orientation sensor: find the rotation ``sensor_from_image`` from lines of a plane.

    Parameters
    ----------
    lines : ImagePoints
        Two points of the plane's line in each frame, or directions (`as_directions`); of the poses, whose
        world has its z axis up, rotations alone are used. If the plane is level, the heading may be wrong.
    pixel_mm : ndarray, shape (2,)
        Column pitch and row spacing; only their ratio matters.
    settings : OrientationFit, optional
        `viewed_from` tells the image from its in-plane mirror, which the lines alone cannot: "above" means
        that on average the beam points down, as over the floor of a water bath. The solution says what was
        assumed.

    Raises
    ------
    InsufficientDataError
        If there are too few lines; they contradict each other; gravity cannot tell the image from its
        mirror; or the motion does not determine the answer, and then the missing motion is named.
    """
    s = settings or OrientationFit()
    size = np.array([pixel_mm[0] / pixel_mm[1], 1.0])
    directions = as_directions(lines, size) if len(lines) == 2 * len(lines.frames) else lines
    normals = hemisphere()
    normals = normals[:1] if s.level else normals[normals[:, 2] > np.cos(STEEPEST_PLANE)]
    starts = angle_starts(directions.of_some_frames(SOME_FRAMES), size, normals, s.level)
    problem = Problem(line_directions(s.level), ANGLES, s.outlier_sigma)
    side = "down (plane seen from above)" if s.viewed_from == "above" else "up (plane seen from below)"
    assumption = f"assumed, as no image tells it: the beam points {side}"
    solution = require_adequate(replace(problem.best(directions, starts), assumed=assumption))
    certain = np.diag(solution.image_covariance(("beta_c", "gamma_c"))).max() < _CERTAIN_RAD**2
    slope = float(np.arccos(min(abs(solution.chain.target[2, 2]), 1.0)))
    if certain and slope > STEEPEST_PLANE:
        raise InsufficientDataError(
            f"expected a plane within {np.rad2deg(STEEPEST_PLANE):.0f} degrees of level, got one at "
            f"{np.rad2deg(slope):.0f}: is the world's z axis up, and are the lines those of the floor?"
        )
    return _upright(solution, s.viewed_from)


def _upright(solution: Solution, viewed_from: str) -> Solution:
    """Of a solution and its in-plane mirror, choose the one whose beams point down (up, if from below).

    Raises
    ------
    InsufficientDataError
        If the beams are level on average.
    """
    down = -float((solution.points_used.turns[:, 2] @ solution.chain.probe[:3, 1]).mean())
    if abs(down) < MIRROR_LIMIT:
        raise InsufficientDataError(
            f"expected beams that point down on average, got {np.rad2deg(np.arcsin(down)):.0f} degrees "
            "below level: gravity cannot tell the image from its mirror; scan a level plane from above, or "
            "say it is seen from below"
        )
    if (down > 0) == (viewed_from == "above"):
        return solution
    # The image's x and y axes are turned by half, and displacements about them with these.
    signs = np.array([-1.0 if name in ("beta", "gamma") else 1.0 for name in solution.free])
    return replace(
        solution,
        chain=solution.chain.mirror(),
        covariance=solution.covariance * np.outer(signs, signs),
        residuals=-solution.residuals,
    )
