"""What the slopes that images see - yaw and tilt per distance travelled - are worth.

A distance that is too long or too short by a share that varies over the image makes frames seem to turn as
they travel. How large such a share may be is what the scale of all distances is uncertain by, and a turn
that it could feign is left out but for the part that sweeps are expected to have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.motion.planes import PairPlane

NEAR_MM = 0.1
"""Frames nearer than this may turn as if they were this far apart: a hand trembles in place."""
UNEVENNESS = 0.4
"""Variation of the error of distances over the image against its mean; measured on simulated sweeps."""
BEYOND_DOUBT = 2.0
"""Deviations at which a turn is taken for deliberate, however large it is."""


@dataclass(frozen=True)
class SlopeEvidence:
    """What seen slopes are worth.

    Attributes
    ----------
    share : ndarray, shape (2,)
        Of the slopes seen along x and y, yaw and tilt, that is believed.
    deviation_per_mm : ndarray, shape (2,)
        Standard deviation of the slopes per distance that is left, 1/mm.
    """

    share: FloatArray
    deviation_per_mm: FloatArray

    def applied(self, plane: PairPlane) -> PairPlane:
        """Keep only the believed shares of a plane's slopes; its offset follows as the fit has it."""
        keep = np.eye(3)
        slopes = plane.covariance[1:, 1:]
        keep[1:, 1:] = np.diag(self.share)
        keep[0, 1:] = -plane.covariance[0, 1:] @ np.linalg.inv(slopes) @ np.diag(1.0 - self.share)
        a, b, c = keep @ plane.coefficients
        sign = -1.0 if a < 0 else 1.0
        covariance = keep @ plane.covariance @ keep.T
        left = self.deviation_per_mm * max(abs(a), NEAR_MM)
        covariance[[1, 2], [1, 2]] += left**2
        return replace(plane, offset_mm=sign * a, slope_x=sign * b, slope_y=sign * c, covariance=covariance)


def weigh_slopes(
    design: FloatArray,
    planes: Sequence[PairPlane],
    scale_sigma: float,
    expected_per_mm: float,
) -> SlopeEvidence:
    """Weigh the slopes that a sweep's planes have.

    Parameters
    ----------
    design : ndarray, shape (p, 3)
        What the planes' coefficients are multiplied by.
    scale_sigma : float
        Relative standard deviation of the scale of distances.
    expected_per_mm : float
        Slope per distance that sweeps have, standard deviation, rad/mm.
    """
    coefficients = np.array([plane.coefficients for plane in planes])
    weight = np.zeros(design.shape[0])
    for plane in planes:
        weight += np.nan_to_num(1.0 / plane.sigma_mm**2)
    lever = np.array([_deviation(design[:, k], weight) for k in (1, 2)])
    false = UNEVENNESS * scale_sigma / np.maximum(lever, 1e-6)
    travelled = np.maximum((coefficients[:, 0] ** 2).sum(), 1e-12)
    seen = (coefficients[:, 1:] * coefficients[:, :1]).sum(axis=0) / travelled
    expected = np.maximum(expected_per_mm**2, seen**2 - (BEYOND_DOUBT * false) ** 2)
    share = expected / (expected + false**2)
    return SlopeEvidence(share, np.sqrt(share) * false)


def _deviation(values: FloatArray, weight: FloatArray) -> float:
    mean = np.average(values, weights=weight)
    return float(np.sqrt(np.average((values - mean) ** 2, weights=weight)))
