"""What the thickness of the beam does to a calibration on a bare wall: a bias along the beam, predicted.

A sheet of thickness w that meets a wall at an angle meets it first with its nearer edge, so that the line
lies (w / 2) |tan(tilt)| / cos(roll) too shallow. The Cambridge phantom, a thin bar, does not do this.

References
----------
.. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, section 3.4 and appendix D.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.plane import Plane, solve
from calibration.solution import Solution
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError

_ROUNDING = 1e-20
"""Variance of cosines that are all the same but for rounding; tilts of a tenth of a degree make 1e-13."""


@dataclass(frozen=True)
class BeamBias:
    """How a beam of some thickness would move the calibration that these motions give.

    Attributes
    ----------
    width_mm : float
        Thickness of the beam.
    closed_form_mm : float
        Displacement of the image along its y axis, from the heights alone; negative: towards the probe.
    simulated_mm : ndarray, shape (3,)
        Displacement of the middle of the lines' points along the image's axes when all parameters are
        estimated.
    rms_mm : float
        Residual that the thickness leaves.
    """

    width_mm: float
    closed_form_mm: float
    simulated_mm: FloatArray
    rms_mm: float


def focal_width_mm(focus_mm: float, wavelength_mm: float, aperture_radius_mm: float) -> float:
    """Thickness of a beam at its focus, its least: F lambda / a (TR 303, appendix D)."""
    if min(focus_mm, wavelength_mm, aperture_radius_mm) <= 0:
        raise InvalidInputError(
            "expected focus, wavelength and aperture radius above zero, got "
            f"{focus_mm:g}, {wavelength_mm:g} and {aperture_radius_mm:g} mm"
        )
    return focus_mm * wavelength_mm / aperture_radius_mm


def depth_error_mm(normal_in_image: FloatArray, width_mm: float) -> FloatArray:
    """How much too shallow lines appear: (w / 2) |n_z / n_y|, the same all along the line.

    Parameters
    ----------
    normal_in_image : ndarray, shape (m, 3)
        The wall's unit normal in the image frame of each line.
    """
    return np.asarray(width_mm / 2.0 * np.abs(normal_in_image[:, 2] / normal_in_image[:, 1]))


def bias_along_beam_mm(normal_in_image: FloatArray, width_mm: float) -> float:
    """Closed form of the bias along y, were all but the image's and the wall's heights known.

    The height error (w / 2)|n_z| is explained best, in the sense of least squares, by moving the image by
    (w / 2) cov(|n_z|, |n_y|) / var(|n_y|) along its y axis, and the wall.
    """
    oblique, along = np.abs(normal_in_image[:, 2]), np.abs(normal_in_image[:, 1])
    spread = float(np.var(along))
    if spread < _ROUNDING:
        return float("nan")
    return width_mm / 2.0 * float(np.mean((oblique - oblique.mean()) * (along - along.mean()))) / spread


def predict_bias(solution: Solution, width_mm: float) -> BeamBias:
    """Predict the bias of a calibration with a bare wall, by simulation of its own motions.

    The lines of a thick beam are put where the wall would show them, and solved for like real ones.

    Raises
    ------
    InvalidInputError
        If `width_mm` is negative or not finite.
    """
    if not (np.isfinite(width_mm) and width_mm >= 0):
        raise InvalidInputError(f"width_mm: expected zero or more, got {width_mm:g}")
    points, chain = solution.points[solution.used], solution.chain
    near = chain.target_from_image(points)
    normal = near.rotation.as_matrix()[:, 2]
    columns = points.pixels[:, 0] * chain.pixel_mm[0]
    exact = -(near.translation[:, 2] + normal[:, 0] * columns) / normal[:, 1]
    rows = (exact - depth_error_mm(normal, width_mm)) / chain.pixel_mm[1]
    thick = replace(points, pixels=np.column_stack([points.pixels[:, 0], rows]))
    probe = tuple(name for name in solution.free if name not in solution.phantom.determined)
    seen = solve(thick, Plane(), chain, probe, outlier_sigma=np.inf)
    middle = points.pixels.mean(axis=0)
    before, after = (
        one.sensor_from_image.apply(np.append(middle * one.pixel_mm, 0.0)) for one in (chain, seen.chain)
    )
    moved = chain.sensor_from_image.rotation.inv().apply(after - before)
    return BeamBias(width_mm, bias_along_beam_mm(normal, width_mm), moved, seen.rms)
