"""Precision over repeated calibrations, and the error of a calibration on recordings it was not made from.

References
----------
.. [1] R. J. Housden et al., BioMedical Engineering OnLine, 2008, Table 1 (roll, yaw and tilt).
.. [2] Prager et al., CUED/F-INFENG/TR 303, 1997, equation 12 and Table 3 (the image's centre).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.points import ImagePoints, as_directions
from calibration.solution import Problem, Solution
from speckle3d.core.arrays import FloatArray
from speckle3d.core.calibration import Calibration
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError


@dataclass(frozen=True)
class Repeatability:
    """Scatter of repeated calibrations about their mean.

    Attributes
    ----------
    trials : int
    roll_yaw_tilt_sd_rad : ndarray, shape (3,)
        About the image's z, y and x axes.
    centre_sd_mm, corner_sd_mm : float, optional
        Root mean square distance of the image's centre, and of its four corners, from their mean place in the
        sensor's frame; None for an orientation sensor.
    centre_shift_mm : ndarray, shape (trials - 1,), optional
        Distance of the centre from its place in the first trial (TR 303, equation 12).
    """

    trials: int
    roll_yaw_tilt_sd_rad: FloatArray
    centre_sd_mm: float | None
    corner_sd_mm: float | None
    centre_shift_mm: FloatArray | None


def repeatability(
    calibrations: Sequence[Calibration], size_px: tuple[int, int] | None = None
) -> Repeatability:
    """Compare repeated calibrations of one mounting.

    Parameters
    ----------
    calibrations : sequence of Calibration, at least two
    size_px : (columns, rows), optional
        Of the image; needed for its centre and corners.

    Raises
    ------
    InsufficientDataError
        If there are fewer than two.
    InvalidInputError
        If the image has no size.
    MismatchError
        If they are not of one kind of sensor.
    """
    if size_px and min(size_px) < 1:
        raise InvalidInputError(f"size_px: expected columns and rows above zero, got {size_px}")
    if len(calibrations) < 2:
        raise InsufficientDataError(f"expected at least two calibrations to compare, got {len(calibrations)}")
    sensors = sorted({c.sensor for c in calibrations})
    if len(sensors) > 1:
        raise MismatchError(f"expected calibrations of one sensor, got {' and '.join(sensors)}")
    turns = Rotation.concatenate([c.rotation for c in calibrations])
    angles = (turns.mean().inv() * turns).as_rotvec()[:, ::-1]
    sd = np.sqrt(np.sum(angles**2, axis=0) / (len(calibrations) - 1))
    if size_px is None or any(c.translation_mm is None for c in calibrations):
        return Repeatability(len(calibrations), sd, None, None, None)
    # The image's centre and its corners in the sensor's frame.
    shares = np.array([[0.5, 0.5], [0, 0], [1, 0], [1, 1], [0, 1]])
    flat = np.column_stack([shares * (np.array(size_px) - 1), np.zeros(5), np.ones(5)])
    places = np.stack([(flat @ c.pixel_matrix().T)[:, :3] for c in calibrations])
    distance = np.linalg.norm(places - places.mean(axis=0), axis=2)
    scatter = np.sqrt(np.sum(distance**2, axis=0) / (len(calibrations) - 1))
    shift = np.linalg.norm(places[1:, 0] - places[0, 0], axis=1)
    corners = float(np.sqrt(np.mean(scatter[1:] ** 2)))
    return Repeatability(len(calibrations), sd, float(scatter[0]), corners, shift)


def validate(solution: Solution, points: ImagePoints) -> FloatArray:
    """Hold a calibration and see how well it explains another recording.

    The plane's position is estimated anew, for it may be another plane, unless it is level; wires are held
    where they were.

    Parameters
    ----------
    points : ImagePoints
        Dots, or two points of each line.

    Returns
    -------
    ndarray, shape (n, r)
        Residuals of all points, none left out, mm (sines of angles for directions).

    Raises
    ------
    InsufficientDataError
        If the recording is too short to find the plane in.
    """
    chain, phantom = solution.chain, solution.phantom
    points = as_directions(points, chain.pixel_mm) if solution.angular else points
    if phantom.seen_as != "dot" and phantom.unknowns:
        return Problem(phantom, (), np.inf).solve(points, chain).residuals
    return phantom.equations(points).residuals(chain)
