"""Values of a frame's patches by its pairs with others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.grid import ImageGrid
from speckle3d.core.reconstruction import FramePairs

NEIGHBOURS = 8
"""Frames before and after with which a frame can be compared."""


@dataclass(frozen=True)
class PatchValues:
    """Patches of one frame as its pair with another has them.

    Attributes
    ----------
    centre_mm : ndarray, shape (p, 2)
        Where the patches lie in this frame.
    turn_rad : ndarray, shape (p,)
        By which they are turned there, a fan's vectors included.
    distance_mm, sigma_mm : ndarray, shape (p,)
        NaN where there is none.
    inliers : ndarray of bool, shape (p,)
        Patches that the plane of the pair rests on.
    elevation_mm : tuple of (float, float)
        How far the image's centre is from the other frame along its elevational axis, and standard deviation.
    """

    centre_mm: FloatArray
    turn_rad: FloatArray
    distance_mm: FloatArray
    sigma_mm: FloatArray
    inliers: BoolArray
    elevation_mm: tuple[float, float]


def patch_values(pairs: FramePairs, grid: ImageGrid, frame: int, partner: int) -> PatchValues | None:
    """Patches of a frame by its pair with another; None for a pair that was not reconstructed."""
    first, second = sorted((frame, partner))
    rows = np.flatnonzero((pairs.first == first) & (pairs.second == second))
    if not rows.size:
        return None
    row = int(rows[0])
    first_from_second = RigidTransform.from_matrix(pairs.first_from_second[row])
    # Patches tile the earlier frame.
    centre_mm = np.column_stack([pairs.patch_centre_mm, np.zeros(len(pairs.patch_centre_mm))])
    turn_rad = -grid.angle_rad(grid.sample_at(pairs.patch_centre_mm)[:, 0])
    if frame == second:
        second_from_first = first_from_second.inv()
        centre_mm = second_from_first.apply(centre_mm)
        turn_rad = turn_rad + second_from_first.rotation.as_euler("zyx")[0]
    elevation_mm = abs(float(first_from_second.apply(grid.centre_mm)[2]))
    return PatchValues(
        centre_mm[:, :2],
        turn_rad,
        pairs.distance_mm[row].astype(float),
        pairs.sigma_mm[row].astype(float),
        pairs.used[row],
        (elevation_mm, float(pairs.covariance[row, 2, 2] ** 0.5)),
    )
