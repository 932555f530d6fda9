"""Settings of calibrations, each stated once: functions, commands and the app read the same models.

Nothing heavy is imported, so that commands can show their options at once.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

Place = Literal["front", "slope", "peak"]
Viewpoint = Literal["above", "below"]

OUTLIER_SIGMA = 4.0
"""One in 16,000 Gaussian residuals is farther out."""
PIXEL_ERROR = 0.02
"""Of a scanner's calipers, of the distances they show."""
BESIDE_MM = 0.1
"""A crossing is bright within tenths of a millimetre of the middle of the beam, where a hand keeps it."""


class _Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class FitSettings(_Settings):
    """Settings common to all calibrations with a phantom."""

    outlier_sigma: float = Field(
        OUTLIER_SIGMA, ge=1.0, description="Drop frames whose residual exceeds so many standard deviations."
    )


class PixelSettings(FitSettings):
    """Settings of the pixel size."""

    fixed_pixels: bool = Field(False, description="Keep the pixel size instead of estimating it.")


class PlaneFit(PixelSettings):
    """Settings of the calibration of a position sensor with a plane."""

    pixel_error: float = Field(
        PIXEL_ERROR, gt=0.0, description="Standard error of the pixel size, as a share of it; inf if a guess."
    )


class OrientationFit(FitSettings):
    """Settings of the calibration of an orientation sensor with a plane."""

    level: bool = Field(False, description="The plane is level: three unknowns, not five.")
    viewed_from: Viewpoint = Field("above", description="Whether the beam points down on average, or up.")


class WireFit(PixelSettings):
    """Settings of the calibration of a position sensor with wires."""

    registration: Literal["auto", "held", "turned", "free"] = Field(
        "auto",
        description="The place a configuration says: hold it, its middle only, or estimate it; auto: "
        "it counts as known to 0.5 mm and 1 degree, unless the dots contradict it.",
    )
    beside_mm: float = Field(
        BESIDE_MM,
        ge=0,
        allow_inf_nan=False,
        description="How far the hand misses a crossing, out of plane, RMS, mm: claims allow for it.",
    )


class LineSettings(_Settings):
    """Settings of the detection of a plane's line, [1]_ appendix B.

    References
    ----------
    .. [1] Prager et al., CUED/F-INFENG/TR 303, 1997.
    """

    columns: int = Field(60, ge=5, description="Columns sampled, at regular intervals (n).")
    smoothing_mm: float = Field(
        0.7,
        gt=0,
        description="Standard deviation of the smoothing down a column whose slope shows edges (sigma).",
    )
    threshold: float | None = Field(
        None,
        gt=0,
        description="Least slope of an edge, grey levels per mm (T); by default echoes are judged by their "
        "brightness instead, against several thresholds, and the first bright line is taken.",
    )
    tolerance_mm: float = Field(0.5, gt=0, description="How far above or below the line an edge agrees (d).")
    consensus: float = Field(
        0.7,
        gt=0,
        le=1,
        description="Share that must agree of the columns in which the line is inside the region (p).",
    )
    place: Place = Field(
        "peak",
        description="Where on an echo the line is put: where it has risen half way (front), where the "
        "smoothed image is steepest (slope; up to smoothing_mm above a thin echo), or where it is brightest "
        "(peak; of a thick beam that meets a wall at an angle, the middle; the front is its nearer edge).",
    )


class ImageFit(_Settings):
    """Settings of the calibration with two crossing sweeps."""

    capture_mm: float = Field(
        20.0,
        ge=0,
        le=100,
        description="How far each displacement of the start may be off.",
    )
    capture_deg: float = Field(20.0, ge=0, le=90, description="How far each angle of the start may be off.")
    tracker_mm: float = Field(
        0.15, ge=0, le=10, description="What the tracker displaces one sweep against the other by."
    )
    tracker_deg: float = Field(
        0.1, ge=0, le=10, description="What it turns one against the other by, each axis."
    )
