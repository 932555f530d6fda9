"""Covariance of poses from the pairs' scatter and the errors common to all pairs."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.poses import (
    SCALE_CHANGE_MM,
    SHARED,
    SIDEWAYS,
    SIDEWAYS_BY_SHARE,
    STRUCTURE,
    TURN_CHANGE_MM,
)
from speckle3d.core.reconstruction import SharedErrors
from speckle3d.motion.planes import PairPlanes, PlaneSettings


def claimed_covariance(
    poses: RigidTransform,
    independent: FloatArray,
    centre_mm: FloatArray,
    shared: SharedErrors,
    structure: float,
) -> FloatArray:
    """Covariance of every frame's pose against the first frame, shape (n, 6, 6).

    Of (x, y, z, tilt, yaw, roll) about the image's centre along the first frame's axes, mm and rad. To the
    pairs' own scatter come the scale of distances, wrong by a share that is the same over the sweep
    and by one that changes along it, slopes seen over the distance travelled, which bend the sweep, and
    structure that runs across, which moves sideways in the image.

    Parameters
    ----------
    poses : RigidTransform, length n
    independent : ndarray, shape (n, 6, 6)
        From `solve_trajectory`, in each frame's own axes.
    shared : SharedErrors
    structure : float
        Mean share of echoes that stay.
    """
    turn = np.zeros((len(poses), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = poses.rotation.as_matrix()
    grown = SHARED * (1.0 + STRUCTURE * structure)
    pair_covariance = turn @ (independent * np.outer(grown, grown)) @ turn.transpose(0, 2, 1)
    covariance = pair_covariance + shared_covariance(poses, centre_mm, shared)
    along = poses.apply(centre_mm)[:, 2:] - poses[0].apply(centre_mm)[2]
    covariance[:, [0, 1], [0, 1]] += ((SIDEWAYS + SIDEWAYS_BY_SHARE * structure) * along) ** 2
    return covariance


def shared_covariance(poses: RigidTransform, centre_mm: FloatArray, shared: SharedErrors) -> FloatArray:
    """Covariance of every frame's pose by errors common to all pairs, shape (n, 6, 6)."""
    common, way = common_factors(poses, centre_mm, shared), travel(poses, centre_mm)
    covariance = np.einsum("mia,mib->iab", common, common)
    covariance[:, 2, 2] += shared.scale_sigma**2 * SCALE_CHANGE_MM * way
    # Each turn on the way moves the centre by its product with what is travelled along z after it.
    z = poses.apply(centre_mm)[:, 2]
    turned, arm, square = (np.cumsum(np.diff(way, prepend=0.0) * z**power) for power in range(3))
    sideways, apart = z * turned - arm, z**2 * turned - 2.0 * z * arm + square
    for angle, place, sign, sigma in zip((4, 3), (0, 1), (1.0, -1.0), shared.turn_sigma_per_mm, strict=True):
        variance = sigma**2 * TURN_CHANGE_MM
        covariance[:, angle, angle] += variance * turned
        covariance[:, place, place] += variance * apart
        covariance[:, [angle, place], [place, angle]] += sign * variance * sideways[:, None]
    return np.asarray(covariance)


def common_factors(poses: RigidTransform, centre_mm: FloatArray, shared: SharedErrors) -> FloatArray:
    """Errors of poses for one deviation of the scale, of yaw and of tilt per mm, shape (3, n, 6)."""
    z = poses.apply(centre_mm)[:, 2]
    z = z - z[0]
    yaw, tilt = shared.turn_sigma_per_mm
    factors = np.zeros((3, len(z), 6))
    factors[0, :, 2] = shared.length_sigma * z
    # A turn that grows with z moves the centre sideways by half of it times z.
    factors[1, :, 4], factors[1, :, 0] = yaw * z, yaw * z**2 / 2
    factors[2, :, 3], factors[2, :, 1] = tilt * z, -tilt * z**2 / 2
    return factors


def travel(poses: RigidTransform, centre_mm: FloatArray) -> FloatArray:
    """Path length of the image's centre up to every frame, shape (n,), mm."""
    steps = np.linalg.norm(np.diff(poses.apply(centre_mm), axis=0), axis=1)
    return np.append(0.0, np.cumsum(steps))


BEYOND_DOUBT = 2.0
"""Deviations at which a turn is taken for deliberate, however large it is. If none is, a turned phantom's
tilt is 3.4 degrees off; if any is, that of B-mode over tissue by 1.9."""


@dataclass(frozen=True)
class SlopeWeights:
    """Weights of the slopes of a sweep's planes, with their remaining errors.

    Attributes
    ----------
    share : ndarray, shape (2,)
        Of the slopes seen along x and y, yaw and tilt, that is believed.
    deviation_per_mm : ndarray, shape (2,)
        Standard deviation of the slopes per distance that is left and steady, rad/mm; the rest wanders as
        `SharedErrors` has it.
    lever_mm : ndarray, shape (2,)
        Where patches lie from the image's centre, on average as planes weigh them.
    """

    share: FloatArray
    deviation_per_mm: FloatArray
    lever_mm: FloatArray

    def applied(self, planes: PairPlanes) -> PairPlanes:
        """Multiply planes' slopes by their weights and adjust the offsets by the fits' covariance."""
        covariance = planes.covariance
        keep = np.tile(np.diag([1.0, *self.share]), (len(planes), 1, 1))
        keep[:, :1, 1:] = -covariance[:, :1, 1:] @ np.linalg.inv(covariance[:, 1:, 1:]) * (1.0 - self.share)
        coefficients = (keep @ planes.coefficients[:, :, None])[:, :, 0]
        covariance = keep @ covariance @ keep.transpose(0, 2, 1)
        covariance[:, [1, 2], [1, 2]] += (coefficients[:, :1] * self.deviation_per_mm) ** 2
        return replace(planes, coefficients=coefficients, covariance=covariance)


def weigh_slopes(
    planes: PairPlanes, false_turn: FloatArray, settings: PlaneSettings, path: FloatArray
) -> SlopeWeights:
    """Weights of all pairs' slopes against false slopes from uneven errors of distances.

    A hand's turn is expected to be steady and to wander, so that its mean per distance is the less certain
    the shorter the sweep; what is feigned changes as much along the way.

    Parameters
    ----------
    false_turn : ndarray, shape (2,)
        Standard deviation of yaw and tilt per distance; see `Coherence`.
    path : ndarray, shape (n, 2) or (n, 3)
        Its first column is each frame's elevational position, mm.
    """
    offset = planes.offset_mm
    mean_slope = offset @ planes.coefficients[:, 1:] / max(float(offset @ offset), 1e-12)
    way_mm = max(np.abs(np.diff(path[:, 0])).sum(), 1e-6)
    steady = way_mm / (way_mm + TURN_CHANGE_MM)
    usual = np.deg2rad(settings.turn_deg_per_mm) ** 2 / steady
    # What is seen may be a turn although not beyond doubt: the mean square less what is feigned.
    feigned = false_turn**2
    share, likely = (
        1.0 / (1.0 + feigned / np.maximum(usual, mean_slope**2 - doubt * feigned))
        for doubt in (BEYOND_DOUBT**2, 1.0)
    )
    variance = steady * (likely * feigned + ((likely - share) * mean_slope) ** 2)
    information = np.linalg.inv(planes.covariance).sum(axis=0)
    return SlopeWeights(share, np.sqrt(variance), information[0, 1:] / information[0, 0])
