"""What is known of an inertial sensor beforehand, and when its word on length is taken."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

ASSUMPTION = (
    "the tissue stays where it is while the probe moves: tissue that follows the probe by 5 % makes the "
    "length 5 % wrong, and no data show it"
)
"""What no data can check, as reports state it."""


class InertialSettings(BaseModel):
    """How an accelerometer and a gyroscope set the length."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    lever_mm: tuple[float, float, float] = Field(
        (0.0, -120.0, 0.0),
        description="Place of the sensor from the image's centre along the image's axes; y is depth.",
    )
    lever_sigma_mm: tuple[float, float, float] = Field(
        (50.0, 80.0, 50.0), description="Standard deviation of `lever_mm`; the data improve on it."
    )
    clock_sigma_s: float = Field(
        0.02,
        gt=0,
        le=0.1,
        description="Standard deviation of the sensor's clock; the data improve on it.",
    )
    gyroscope_bias_deg_s: float = Field(2.0, gt=0, description="Standard deviation of the gyroscope's bias.")
    accelerometer_bias_m_s2: float = Field(
        0.2, gt=0, description="Standard deviation of the accelerometer's bias, gravity's leak included."
    )
    accelerometer_scale_sigma: float = Field(
        0.003, ge=0, description="Relative standard deviation of the accelerometer's own scale."
    )
    trusted_sigma: float = Field(
        0.02, gt=0, description="Relative standard deviation of the length up to which it is fully trusted."
    )
    largest_sigma: float = Field(
        0.035,
        gt=0,
        description="Relative standard deviation of the length above which it is refused: of weak motions, "
        "claims beyond it were too small.",
    )
    knot_hz: float = Field(60.0, ge=20, le=200, description="Knots of the motion's splines per second.")
    orientation_sigma_deg: float = Field(
        0.15, gt=0, description="Slow error of the sensor's inclination, standard deviation."
    )
    heading_sigma_deg: float = Field(0.5, gt=0, description="Slow error of its heading, standard deviation.")
    wander_s: float = Field(40.0, gt=0, description="Time over which these errors change.")
