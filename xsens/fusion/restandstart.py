"""What the filter finds out beside its state: whether the sensor rests, and what its first second shows."""

from __future__ import annotations

import math

import numpy as np

from speckle3d.core.arrays import FloatArray
from xsens.fusion.increments import Increment
from xsens.fusion.quaternions import turn_matrix
from xsens.fusion.settings import FusionSettings


class RestDetector:
    """Whether the sensor rests: both readings near their means of the last half second, for a while."""

    _MEMORY_S = 0.5

    def __init__(self, settings: FusionSettings) -> None:
        self._settings = settings
        self._rate: FloatArray | None = None
        self._force = np.zeros(3)
        self._still_s = 0.0

    def rests(self, increment: Increment, bias_rad_s: FloatArray, bias_sd_rad_s: float) -> bool:
        """Whether it rests, given the bias and how well it is known."""
        force = increment.velocity_m_s / increment.duration_s
        if self._rate is None:
            self._rate, self._force = increment.rate_rad_s.copy(), force
        rate_off, force_off = increment.rate_rad_s - self._rate, force - self._force
        share = increment.duration_s / (self._MEMORY_S + increment.duration_s)
        self._rate += share * rate_off
        self._force = self._force + share * force_off
        limit = self._settings.rest_bias_rad_s + 3.0 * bias_sd_rad_s
        still = (
            math.hypot(*rate_off) < self._settings.rest_rate_rad_s
            and math.hypot(*force_off) < self._settings.rest_force_m_s2
            and math.hypot(*(self._rate - bias_rad_s)) < limit
        )
        self._still_s = self._still_s + increment.duration_s if still else 0.0
        return self._still_s > self._settings.rest_after_s


class Start:
    """Means of the first increments."""

    def __init__(self) -> None:
        self.duration_s = self.field_s = 0.0
        self._turn = np.eye(3)  # first axes from the axes of now
        self._force, self._field = np.zeros(3), np.zeros(3)

    def add(self, increment: Increment) -> None:
        """Take in the next increment."""
        self._force = self._force + self._turn @ increment.velocity_m_s
        if increment.field_au is not None:
            self._field = self._field + self._turn @ increment.field_au * increment.duration_s
            self.field_s += increment.duration_s
        self._turn = self._turn @ increment.turn
        self.duration_s += increment.duration_s

    def level(self) -> FloatArray:
        """Level from sensor at the end of the last increment."""
        return upright(self._force) @ self._turn

    def field(self) -> FloatArray:
        """Mean field, in the sensor's axes at the end of the last increment."""
        return self._field @ self._turn / self.field_s


def upright(force: FloatArray) -> FloatArray:
    """The rotation by the shortest way that takes `force` to up."""
    norm = float(np.linalg.norm(force))
    up = force / norm if norm > 0.0 else np.array([0.0, 0.0, 1.0])
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine, cosine = float(np.linalg.norm(axis)), float(up[2])
    if sine < 1e-9:
        return np.diag([1.0, math.copysign(1.0, cosine), math.copysign(1.0, cosine)])
    return turn_matrix(axis / sine * math.atan2(sine, cosine))
