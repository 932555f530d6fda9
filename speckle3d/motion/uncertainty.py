"""How far poses may be off: what frame pairs scatter by, and what all of them have wrong together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.relative import SCALE_CHANGE_MM, SHARED, STRUCTURE, TURN_CHANGE_MM
from speckle3d.motion.planes import PairPlanes


def pose_covariance(
    poses: RigidTransform,
    independent: FloatArray,
    centre_mm: FloatArray,
    scale_sigma: float,
    slopes: SlopeEvidence,
    share: float = 0.0,
) -> FloatArray:
    """Covariance of every frame's pose against the first frame, shape (n, 6, 6).

    Of (x, y, z, tilt, yaw, roll) about the image's centre along the first frame's axes, mm and rad. To the
    pairs' own scatter come the scale of distances, wrong by a share that is the same over the sweep
    and by one that changes along it, and slopes seen over the distance travelled, which bend the sweep.

    Parameters
    ----------
    poses : RigidTransform, length n
    independent : ndarray, shape (n, 6, 6)
        From `solve_trajectory`, in each frame's own axes.
    scale_sigma : float
        Relative standard deviation of the scale of distances.
    share : float
        Mean share of echoes that stay.
    """
    turn = np.zeros((len(poses), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = poses.rotation.as_matrix()
    grown = SHARED * (1.0 + STRUCTURE * share)
    covariance = turn @ (independent * np.outer(grown, grown)) @ turn.transpose(0, 2, 1)
    centres = poses.apply(centre_mm)
    z = centres[:, 2] - centres[0, 2]
    travel = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1))])
    covariance[:, 2, 2] += scale_sigma**2 * (z**2 + SCALE_CHANGE_MM * travel)
    yaw, tilt = slopes.deviation_per_mm
    for angle, shift, rate, sign in ((4, 0, yaw, 1.0), (3, 1, tilt, -1.0)):
        # A turn that grows with z moves the centre sideways by half of it times z.
        along = np.zeros((len(z), 6))
        along[:, angle], along[:, shift] = z, sign * z**2 / 2
        covariance += rate**2 * along[:, :, None] * along[:, None, :]
        covariance[:, angle, angle] += rate**2 * TURN_CHANGE_MM * travel
    return np.asarray((covariance + covariance.transpose(0, 2, 1)) / 2)


def with_common_scale(
    covariance: FloatArray, poses: RigidTransform, centre_mm: FloatArray, sigma: float
) -> FloatArray:
    """Covariance of poses to which an error comes that stretches the whole sweep by one factor.

    Parameters
    ----------
    covariance : ndarray, shape (n, 6, 6)
        As from `pose_covariance`.
    sigma : float
        Relative standard deviation of the factor.
    """
    centres = poses.apply(centre_mm)
    along = np.zeros((len(covariance), 6, 6))
    along[:, 2, 2] = (sigma * (centres[:, 2] - centres[0, 2])) ** 2
    return covariance + along


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

    def applied(self, planes: PairPlanes) -> PairPlanes:
        """Keep only the believed shares of planes' slopes; their offsets follow as the fits have it."""
        covariance = planes.covariance
        keep = np.zeros_like(covariance)
        keep[:, 0, 0] = 1.0
        keep[:, [1, 2], [1, 2]] = self.share
        slopes = np.linalg.inv(covariance[:, 1:, 1:])
        keep[:, :1, 1:] = -covariance[:, :1, 1:] @ slopes * (1.0 - self.share)
        kept = (keep @ planes.coefficients[:, :, None])[:, :, 0]
        covariance = keep @ covariance @ keep.transpose(0, 2, 1)
        left = np.maximum(np.abs(kept[:, :1]), NEAR_MM) * self.deviation_per_mm
        covariance[:, [1, 2], [1, 2]] += left**2
        sign = np.where(kept[:, :1] < 0, -1.0, 1.0)
        return replace(planes, coefficients=sign * kept, covariance=covariance)


def weigh_slopes(
    design: FloatArray,
    planes: PairPlanes,
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
    coefficients = planes.coefficients
    weight = np.nansum(planes.sigma_mm**-2.0, axis=0, dtype=float)
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
