"""How far poses may be off: what frame pairs scatter by, and what all of them have wrong together."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.geometry import FloatArray
from speckle3d.motion.slopes import SlopeEvidence

SHARED = 2.0
"""Variance of a pose over what the graph has it if pairs were independent: pairs that share a frame also share
its speckle. Measured on simulated sweeps."""
CHANGE_MM = 2.0
"""Travel over which the error of the scale changes: it does so with the tissue."""


def pose_covariance(
    poses: RigidTransform,
    independent: FloatArray,
    centre_mm: FloatArray,
    scale_sigma: float,
    slopes: SlopeEvidence,
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
    """
    turn = np.zeros((len(poses), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = poses.rotation.as_matrix()
    covariance = SHARED * turn @ independent @ turn.transpose(0, 2, 1)
    centres = poses.apply(centre_mm)
    z = centres[:, 2] - centres[0, 2]
    travel = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1))])
    covariance[:, 2, 2] += scale_sigma**2 * (z**2 + CHANGE_MM * travel)
    yaw, tilt = slopes.deviation_per_mm
    for angle, shift, rate, sign in ((4, 0, yaw, 1.0), (3, 1, tilt, -1.0)):
        # A turn that grows with z moves the centre sideways by half of it times z.
        along = np.zeros((len(z), 6))
        along[:, angle], along[:, shift] = z, sign * z**2 / 2
        covariance += rate**2 * along[:, :, None] * along[:, None, :]
        covariance[:, angle, angle] += rate**2 * CHANGE_MM * travel
    return np.asarray((covariance + covariance.transpose(0, 2, 1)) / 2)
