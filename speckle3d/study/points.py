"""How far a reconstruction is from a reference: displacement of points, and drift of the image centre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.core.geometry import FloatArray, relative_poses


@dataclass(frozen=True)
class PointErrors:
    """Displacement errors over an image's points, mean over frames 1 to n - 1, mm.

    `global_mm` compares poses relative to the first frame (GPE, or GLE at landmarks), `local_mm` poses
    relative to the frame before (LPE, LLE).
    """

    global_mm: float
    local_mm: float


@dataclass(frozen=True)
class DriftRates:
    """Drift of the image centre with both first frames aligned.

    Attributes
    ----------
    final_drift_rate, average_drift_rate : float
        Drift at the last frame, and mean over frames, as shares of the true path length so far.
    maximum_drift_mm, sum_of_drift_mm : float
    mean_angle_deg : float
        Mean over frames of the absolute angle between estimated and true orientation.
    """

    final_drift_rate: float
    average_drift_rate: float
    maximum_drift_mm: float
    sum_of_drift_mm: float
    mean_angle_deg: float


def point_errors(
    world_from_image: RigidTransform, reference: RigidTransform, points_mm: npt.ArrayLike
) -> PointErrors:
    """Displacement errors at points of the image, shape (p, 3), as in the TUS-REC challenge."""
    points = np.asarray(points_mm, dtype=float)
    _require_same_length(world_from_image, reference, "reference")
    found, true = (p[0].inv() * p[1:] for p in (world_from_image, reference))
    whole = _mean_distance(found, true, points)
    return PointErrors(
        whole, _mean_distance(relative_poses(world_from_image), relative_poses(reference), points)
    )


def drift_rates(
    world_from_image: RigidTransform, reference: RigidTransform, centre_mm: npt.ArrayLike
) -> DriftRates:
    """Relate the drift of the image centre to the path it travelled; see `DriftRates`.

    Raises
    ------
    InsufficientDataError
        If the reference does not move.
    """
    centre = np.asarray(centre_mm, dtype=float)
    _require_same_length(world_from_image, reference, "reference")
    found, true = (p[0].inv() * p for p in (world_from_image, reference))
    path = true.apply(centre)
    travelled = np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))
    if not travelled[-1] > 0:
        raise InsufficientDataError("drift rates: expected a reference that moves, got one that rests")
    drift = np.linalg.norm(found.apply(centre) - path, axis=1)[1:]
    moved = travelled > 0
    angle = np.rad2deg(np.atleast_1d((true.rotation.inv() * found.rotation).magnitude())[1:])
    return DriftRates(
        final_drift_rate=float(drift[-1] / travelled[-1]),
        average_drift_rate=float(np.mean(drift[moved] / travelled[moved])),
        maximum_drift_mm=float(drift.max()),
        sum_of_drift_mm=float(drift.sum()),
        mean_angle_deg=float(angle.mean()),
    )


def _mean_distance(found: RigidTransform, true: RigidTransform, points: FloatArray) -> float:
    moved = [pose.as_matrix()[:, :3, :3] @ points.T + pose.translation[:, :, None] for pose in (found, true)]
    return float(np.linalg.norm(moved[0] - moved[1], axis=1).mean())


def _require_same_length(poses: RigidTransform, other: RigidTransform, name: str) -> None:
    if len(poses) != len(other):
        raise MismatchError(f"{name}: expected {len(poses)} poses, got {len(other)}")
