"""Relative poses measured between frames: the edges of a graph whose nodes are the frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.geometry import mirrored
from speckle3d.core.shown import shown

MIRROR = np.diag([1.0, 1.0, -1.0, -1.0, -1.0, 1.0])
"""What a mirror in the first image's plane does to (x, y, z, tilt, yaw, roll)."""


SHARED = np.array([3.2, 3.8, 1.4, 1.4, 1.4, 4.5])
"""Deviations of (x, y, z, tilt, yaw, roll) over what the graph has them if pairs were independent: pairs
that share a frame share its speckle, and in-plane shifts their interpolation's error. Measured on simulated
phantoms, as the other figures here."""
STRUCTURE = np.array([19.0, 0.0, 0.0, 0.0, 0.0, 8.0])
"""Growth of these with the share of echoes that stay: structure that runs across hides motion along it."""
SCALE_CHANGE_MM = 2.0
"""Travel over which the error of the scale changes, with the tissue."""
TURN_CHANGE_MM = 40.0
"""Travel up to which a hand's turns wander rather than go on: with a steady rate of 0.05 degrees/mm they
grow to 0.3 degrees in 1 mm, 0.7 in 4, 1.0 in 8 and 2.0 in 24. Tracked hands over phantoms turn by 0.3, 0.7 to
0.9, 1.0 to 1.7 and 1.7 to 4.5 about each axis."""

HELD = np.array([1.0, 1.0, 1.0, 0.05, 0.05, 0.05])
"""How far a probe may go between two frames that no pair joins, deviations of (x, y, z, tilt, yaw, roll), mm
and rad: 25 mm and 70 degrees in a second at 25 frames."""


@shown
@dataclass(frozen=True)
class RelativePoses:
    """Edges of the graph: the second frame's pose in the first, about the image's centre.

    Attributes
    ----------
    first, second : ndarray, shape (e,)
    poses : RigidTransform, length e
    covariance : ndarray, shape (e, 6, 6)
        Of (x, y, z, tilt, yaw, roll), mm and rad.
    """

    first: IntArray
    second: IntArray
    poses: RigidTransform
    covariance: FloatArray

    def __len__(self) -> int:
        return int(self.first.size)

    def mirrored(self) -> RelativePoses:
        """Edges of the mirrored sweep."""
        return RelativePoses(self.first, self.second, mirrored(self.poses), MIRROR @ self.covariance @ MIRROR)
