"""What the page of a sensor shows, of a log or of a sensor at work: columns over time, a judgement, facts."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from xsens.fusion.field import Trust

COLUMNS = ("t", "x", "y", "z", "field", "dip", "heading", "low", "high", "doubt")
NORMAL_95 = 1.96

Columns = dict[str, FloatArray]
"""By the names of `COLUMNS`: time, s; gyroscope, degrees per second; norm of the field; its dip and the
heading, degrees; ends of the heading's 95 % interval; norm again where the field is not believed; or NaN."""


class Source(Protocol):
    """A sensor's readings."""

    is_live: bool

    def columns(self) -> Columns:
        """Return all that is shown over the time."""

    def gaps_s(self) -> list[float]:
        """Return when samples are missing."""

    def judgement(self) -> tuple[Trust, str]:
        """Return whether the magnetometer can be trusted here, and why."""

    def orientation_at(self, time_s: float) -> Rotation | None:
        """Return world from sensor at a time; of a live sensor, now."""

    def facts(self, time_s: float) -> list[tuple[str, str]]:
        """Return names and values of what there is to say at a time."""


def heading_rad(rotation: Rotation) -> FloatArray:
    """Heading about up, from north to west, without jumps."""
    matrices = rotation.as_matrix().reshape(-1, 3, 3)
    return np.asarray(np.unwrap(np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])))


def angles(rotation: Rotation) -> tuple[str, str]:
    """Name and value of roll, pitch and yaw."""
    return "roll, pitch, yaw", ", ".join(
        f"{angle:+.1f}°" for angle in rotation.as_euler("ZYX", degrees=True)[::-1]
    )
