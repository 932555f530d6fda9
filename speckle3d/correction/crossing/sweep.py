"""Inputs and settings of the comparison of two crossing sweeps."""

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.poses import SIDEWAYS
from speckle3d.correction.crossing.stack import ImageStack


class CrossingSettings(BaseModel):
    """Settings of the registration of two crossing sweeps and of its acceptance."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    blurs_mm: tuple[float, ...] = Field(
        (2.0, 0.9, 0.45),
        min_length=1,
        description="Standard deviations of the Gaussian that the images are compared under, coarse to fine.",
    )
    samples: int = Field(
        12_000,
        ge=1_000,
        le=200_000,
        description="Points of each sweep that are looked for in the other, about.",
    )
    effective_samples: float = Field(
        500.0, gt=0, description="How many independent comparisons these are worth against the priors."
    )
    tissue_sigma: float = Field(
        0.03,
        gt=0,
        le=0.5,
        description="Relative standard deviation of what the scale of one sweep differs by from the other's, "
        "with the tissue, and changes by along it.",
    )
    # With the probe's own echoes tilts of simulated sweeps were up to 3 degrees wrong, without them 0.4.
    nearest_mm: float = Field(
        3.0,
        ge=0,
        le=20,
        description="Depth above which nothing is looked at: the pulse and the probe's own echoes go with "
        "the probe.",
    )
    depth_shift_mm: float = Field(
        6.0,
        ge=0,
        le=30,
        description="How much deeper one sweep may see the tissue than the other: the skin is pressed in.",
    )
    least_angle_deg: float = Field(
        30.0, ge=10, le=90, description="Angle between the sweeps below which a pair is refused."
    )
    least_overlap_mm: float = Field(
        18.0,
        gt=0,
        description="Length along either sweep that the other sees, below which a pair is refused.",
    )
    least_similarity: float = Field(
        0.5, ge=0, le=1, description="Correlation of the images below which a pair is refused."
    )
    least_margin: float = Field(
        10.0,
        ge=0,
        description="Logarithm by which the best way of laying the sweeps together must be likelier than any "
        "other.",
    )
    largest_sigma: float = Field(
        0.05,
        gt=0,
        description="Relative standard deviation of the length above which a pair is refused; images alone "
        "leave 8 % open.",
    )


@dataclass(frozen=True)
class CrossingSweep:
    """One of two crossing sweeps.

    Attributes
    ----------
    name : str
        For messages.
    stack : ImageStack
        Its reduced images.
    poses : RigidTransform, length n
        Of mode `image`: ``first_from_image``.
    centre_mm : ndarray, shape (3,)
        The image's centre.
    scale_sigma : float
        Relative standard deviation of the scale of distances that both sweeps share, with what curves of
        another probe or another attenuation can do.
    turn_sigma_per_mm : float
        Standard deviation of tilt and yaw that the images lack, rad/mm.
    orientation : Rotation of length n, or None
        ``world_from_image`` by an orientation sensor or tracker.
    flags : ndarray of int, shape (n,), or None
        Not zero for frames that are not to be trusted.
    frame_time_s : ndarray, shape (n,), or None
        By which a sweep is known again; see `CrossedPair.of`.
    sideways_per_mm : float
        Standard deviation of motion along x that the images see for each mm along z.
    """

    name: str
    stack: ImageStack
    poses: RigidTransform
    centre_mm: FloatArray
    scale_sigma: float
    turn_sigma_per_mm: float
    orientation: Rotation | None = None
    flags: IntArray | None = None
    frame_time_s: FloatArray | None = None
    sideways_per_mm: float = SIDEWAYS

    @property
    def good(self) -> IntArray:
        """Numbers of the frames to be trusted."""
        flags = np.zeros(len(self.poses), int) if self.flags is None else self.flags
        return np.flatnonzero(flags == 0)
