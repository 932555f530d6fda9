"""Bias of a calibration on a bare wall by the beam's thickness.

A sheet of thickness w that meets a wall at an angle meets it first with its nearer edge, so that the line
lies (w / 2) |tan(tilt)| / cos(roll) too shallow. The Cambridge phantom, a thin bar, does not do this.

References
----------
.. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, section 3.4 and appendix D.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.solution import Problem, Solution
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError


@dataclass(frozen=True)
class BeamBias:
    """Predicted bias of a calibration by the beam's thickness.

    Attributes
    ----------
    width_mm : float
        Thickness of the beam.
    shift_mm : ndarray, shape (3,)
        Displacement of the middle of the lines' points along the image's axes when all parameters are
        estimated.
    rms_mm : float
        Residual that the thickness leaves.
    """

    width_mm: float
    shift_mm: FloatArray
    rms_mm: float


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
    too_shallow = width_mm / 2.0 * np.abs(normal[:, 2] / normal[:, 1])
    rows = (exact - too_shallow) / chain.pixel_mm[1]
    thick = replace(points, pixels=np.column_stack([points.pixels[:, 0], rows]))
    probe = tuple(name for name in solution.free if name not in solution.phantom.unknowns)
    refit = Problem(solution.phantom, probe, np.inf).solve(thick, chain)
    middle = points.pixels.mean(axis=0)
    before, after = (np.append(middle * c.pixel_mm, 0.0) for c in (chain, refit.chain))
    shift = (chain.sensor_from_image.inv() * refit.chain.sensor_from_image).apply(after) - before
    return BeamBias(width_mm, shift, refit.rms)
