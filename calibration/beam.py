"""Bias along the beam that the beam's thickness causes in a calibration on a bare wall.

A sheet of thickness w that meets a wall at an angle meets it first with its nearer edge, so that the line
lies (w / 2) |tan(tilt)| / cos(roll) too shallow. The Cambridge phantom, a thin bar, does not do this.

References
----------
.. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, section 3.4 and appendix D.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.plane import Problem, Solution
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError

_ROUNDING = 1e-20
"""Variance of equal cosines, from rounding; tilts of a tenth of a degree make 1e-13."""


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


def depth_error_mm(normal_in_image: FloatArray, width_mm: float) -> FloatArray:
    """How much too shallow lines appear, (w / 2) |n_z / n_y|, for normals of the wall in images, (m, 3)."""
    return np.asarray(width_mm / 2.0 * np.abs(normal_in_image[:, 2] / normal_in_image[:, 1]))


def bias_along_beam_mm(normal_in_image: FloatArray, width_mm: float) -> float:
    """Closed form of the bias along y if only the heights of the image and the wall were unknown.

    Least squares explain the height error (w / 2)|n_z| by moving the wall, and the image along its y axis by
    (w / 2) cov(|n_z|, |n_y|) / var(|n_y|). NaN where the wall was met at one angle only.
    """
    oblique, along = np.abs(normal_in_image[:, 2]), np.abs(normal_in_image[:, 1])
    spread = float(np.var(along))
    if spread < _ROUNDING:
        return float("nan")
    return width_mm / 2.0 * float(np.mean((oblique - oblique.mean()) * (along - along.mean()))) / spread


def predict_bias(solution: Solution, width_mm: float) -> BeamBias:
    """Predict the bias of a calibration with a bare wall, by simulation of its own motions.

    Lines are placed where a thick beam would show the wall, and a calibration is solved from them.

    Raises
    ------
    InvalidInputError
        If `width_mm` is negative or not finite.
    """
    if not (np.isfinite(width_mm) and width_mm >= 0):
        raise InvalidInputError(f"width_mm: expected zero or more, got {width_mm:g}")
    points, chain = solution.points_used, solution.chain
    near = chain.target_from_image(points)
    normal = near.rotation.as_matrix()[:, 2]
    columns = points.pixels[:, 0] * chain.pixel_mm[0]
    exact = -(near.translation[:, 2] + normal[:, 0] * columns) / normal[:, 1]
    rows = (exact - depth_error_mm(normal, width_mm)) / chain.pixel_mm[1]
    thick = replace(points, pixels=np.column_stack([points.pixels[:, 0], rows]))
    probe = tuple(name for name in solution.free if name not in solution.phantom.determined)
    seen = Problem(solution.phantom, probe, np.inf).solve(thick, chain)
    middle = points.pixels.mean(axis=0)
    before, after = (
        one.sensor_from_image.apply(np.append(middle * one.pixel_mm, 0.0)) for one in (chain, seen.chain)
    )
    moved = chain.sensor_from_image.rotation.inv().apply(after - before)
    return BeamBias(width_mm, bias_along_beam_mm(normal, width_mm), moved, seen.rms)
