"""Columns over time and angles that the page of a sensor shows, of a log or of a sensor at work."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray

COLUMNS = ("t", "x", "y", "z", "field", "dip", "heading", "low", "high", "doubt")
NORMAL_95 = 1.96

Columns = dict[str, FloatArray]
"""By the names of `COLUMNS`: time, s; gyroscope, degrees per second; norm of the field; its dip and the
heading, degrees; ends of the heading's 95 % interval; norm again where the field is not believed; or NaN."""


def heading_rad(rotation: Rotation) -> FloatArray:
    """Heading about up, from north to west, without jumps."""
    matrices = rotation.as_matrix().reshape(-1, 3, 3)
    return np.asarray(np.unwrap(np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])))


def angles(rotation: Rotation) -> tuple[str, str]:
    """Name and value of roll, pitch and yaw."""
    return "roll, pitch, yaw", ", ".join(
        f"{angle:+.1f}°" for angle in rotation.as_euler("ZYX", degrees=True)[::-1]
    )
