"""What mode ``fused`` assumes of the sensors."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class FusedSettings(BaseModel):
    """What is assumed of the sensors beside their readings."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    mounting_sigma_rad: float = Field(
        0.006,
        gt=0,
        description="How well it is known how the image is turned on a sensor: a third of a degree.",
    )
    mounting_sigma_mm: float = Field(0.5, gt=0, description="How well its place on a tracker is known.")
    clock_sigma_s: float = Field(0.005, gt=0, description="How well the sensors' clocks are known.")
    tracker_scale_sigma: float = Field(
        0.004, gt=0, description="Relative error of a tracker's millimetres: distortion of its field."
    )
    inclination_sigma_rad: float = Field(
        0.0026, gt=0, description="Slow error of an orientation sensor's inclination: 0.15 degrees."
    )
    heading_sigma_rad: float = Field(0.0087, gt=0, description="Slow error of its heading: half a degree.")
    wander_s: float = Field(40.0, gt=0, description="Time in which these errors change.")
    contradiction_sigma: float = Field(
        6.0, gt=0, description="Deviations by which a sensor must differ from the images to contradict them."
    )
