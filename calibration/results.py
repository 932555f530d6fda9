"""From the solver's answer to a calibration that can be saved and used."""

from __future__ import annotations

import numpy as np

from calibration.chain import CHAIN, SCALES, residuals_and_jacobian
from calibration.identifiability import judge
from calibration.solution import Solution
from speckle3d.core.calibration import Calibration, FramesUsed, Parameter
from speckle3d.core.leastsquares import clustered_covariance, correlated_lags

IMAGE_POSE = ("gamma", "beta", "alpha", "x", "y", "z")
"""Tilt, yaw, roll and displacements: small angles in frames that lie on the image."""


def as_calibration(
    solution: Solution, method: str, frames: FramesUsed, time_offset_s: float | None = None
) -> Calibration:
    """Put a solution into the form that is saved, with standard errors in the published parameters.

    Parameters
    ----------
    frames : FramesUsed
        With the frames in which nothing was found or that no sensor reading covers; those that the solver
        left out are added here.
    """
    angular = solution.phantom.seen_as == "direction"
    chain, pose = solution.chain, IMAGE_POSE[:3] if angular else IMAGE_POSE
    return Calibration(
        method=method,
        sensor="orientation" if angular else "tracker",
        rotation=chain.sensor_from_image.rotation,
        translation_mm=None if angular else np.asarray(chain.sensor_from_image.translation),
        pixel_mm=None if angular else chain.pixel_mm,
        covariance=solution.image_covariance(pose),
        parameters=_parameters(solution),
        rms=solution.rms,
        rms_unit="rad" if angular else "mm",
        condition_number=solution.condition_number,
        frames=_frames(solution, frames),
        time_offset_s=time_offset_s,
        verdict=judge(solution).verdict,
    )


def _parameters(solution: Solution) -> tuple[Parameter, ...]:
    """Those estimated, in the sensor's and the world's own frames."""
    values = solution.chain.parameters()
    used = solution.points[solution.used]
    residuals, jacobian = residuals_and_jacobian(values, used, solution.phantom)
    columns = [CHAIN.index(name) for name in solution.free]
    matrix = jacobian.reshape(-1, len(CHAIN))[:, columns]
    lags = correlated_lags(residuals.ravel(), used.frame)
    errors = np.sqrt(np.diag(clustered_covariance(matrix, residuals.ravel(), used.frame, lags)))
    return tuple(
        Parameter(name, float(values[column]), float(error), _unit(name))
        for name, column, error in zip(solution.free, columns, errors, strict=True)
    )


def _unit(name: str) -> str:
    if name in SCALES:
        return "mm/pixel"
    return "mm" if name[0] in "xyz" else "rad"


def _frames(solution: Solution, frames: FramesUsed) -> FramesUsed:
    """Add the frames that contradict the others, with their residuals."""
    angular = solution.phantom.seen_as == "direction"
    dropped = dict(frames.dropped)
    for number in np.unique(solution.points.frame[~solution.used]):
        worst = float(np.abs(solution.residuals[solution.points.frame == number]).max())
        size = f"{np.rad2deg(worst):.1f} degrees" if angular else f"{worst:.1f} mm"
        dropped[int(number)] = f"contradicts the other frames by {size}"
    used = tuple(int(n) for n in np.unique(solution.points.frame[solution.used]))
    return FramesUsed(frames.given, used, dropped)
