"""The published way: Nelder-Mead on the mean correlation of whole images with cuts of the other sweep.

References
----------
.. [1] W. Wein and A. Khamene, "Image-based method for in-vivo freehand ultrasound calibration", SPIE Medical
   Imaging, 2008, section 2.2.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.images.crossing import Crossing, Progress
from calibration.images.fit import Estimate
from speckle3d.core.arrays import FloatArray

IMAGES = 8
"""Of each sweep; published: 5 to 10."""

MAX_EVALUATIONS = 1500

_STEP = 10.0
"""Edges of the first simplex, mm and degrees: half of the displacements it is to recover from."""


@dataclass(frozen=True)
class Simplex:
    """What Nelder-Mead arrived at."""

    estimate: Estimate
    evaluations: int
    converged: bool


def climb(
    crossing: Crossing,
    start: Estimate,
    scales: bool,
    pool: ThreadPoolExecutor,
    progress: Progress | None = None,
) -> Simplex:
    """Maximise over an increment of Euler angles and translation that starts at zero and multiplies right."""
    comparison = crossing.published(IMAGES)
    count = 0

    def unlike(increment: FloatArray) -> float:
        nonlocal count
        count += 1
        if progress:
            progress("simplex", count, MAX_EVALUATIONS)
        at = incremented(start, increment)
        mean = comparison.at(at.sensor_from_image, at.scales, pool=pool).mean
        return 1.0 - mean if np.isfinite(mean) else 2.0

    size = 8 if scales else 6
    corners = np.vstack([np.zeros(size), np.diag([_STEP] * 6 + [2.0] * (size - 6))])
    found = minimize(
        unlike,
        np.zeros(size),
        method="Nelder-Mead",
        options={"initial_simplex": corners, "xatol": 0.02, "fatol": 1e-5, "maxfev": MAX_EVALUATIONS},
    )
    return Simplex(incremented(start, found.x), int(found.nfev), bool(found.success))


def incremented(start: Estimate, increment: FloatArray) -> Estimate:
    """Right-multiply an increment: Euler angles about x, y, z in degrees, mm; then scales in per cent."""
    turn = Rotation.from_euler("xyz", increment[:3], degrees=True)
    moved = start.sensor_from_image * RigidTransform.from_components(increment[3:6], turn)
    scales = start.scales * (1.0 + 0.01 * increment[6:8]) if len(increment) > 6 else start.scales
    return Estimate(moved, scales)
