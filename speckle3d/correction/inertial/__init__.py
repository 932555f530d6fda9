"""Length from an accelerometer and a gyroscope on the probe: image steps tied to m/s^2."""

from __future__ import annotations

from speckle3d.correction.inertial.expected import ExpectedError, InertialPlan, expected_scale_error
from speckle3d.correction.inertial.scale import correct_inertial
from speckle3d.correction.inertial.settings import ASSUMPTION, InertialSettings

__all__ = [
    "ASSUMPTION",
    "ExpectedError",
    "InertialPlan",
    "InertialSettings",
    "correct_inertial",
    "expected_scale_error",
]
