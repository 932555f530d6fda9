"""Settings of the sensors' systematic errors: mounting, clock, scale, slow drift."""

from pydantic import BaseModel, ConfigDict, Field


class FusedSettings(BaseModel):
    """Systematic errors of sensors, for mode `fused` and the claims of all modes."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    mounting_sigma_rad: float = Field(
        0.006,
        gt=0,
        description="How well it is known how the image is turned on a sensor: a third of a degree.",
    )
    mounting_sigma_mm: float = Field(0.5, gt=0, description="How well its place on a tracker is known.")
    clock_sigma_s: float = Field(0.005, gt=0, description="How well the sensors' clocks are known.")
    # A probe's metal bends the field of electromagnetic trackers: 2 % off is to lie within three deviations.
    tracker_scale_sigma: float = Field(
        0.007, gt=0, description="Relative error of a tracker's millimetres: distortion of its field."
    )
    inclination_sigma_rad: float = Field(
        0.0026, gt=0, description="Slow error of an orientation sensor's inclination: 0.15 degrees."
    )
    # An MT9-B at rest wanders by so much in 40 s; one near steel, simulated, by 0.9 degrees in seconds:
    # that is within three deviations.
    heading_sigma_rad: float = Field(0.0087, gt=0, description="Slow error of its heading: half a degree.")
    wander_s: float = Field(5.0, gt=0, description="Time in which these errors change.")
