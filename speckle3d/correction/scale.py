"""Poses whose length comes from a source other than the images, and the evidence for their scale."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.shown import shown

TERMS = ("log_scale", "tilt_per_mm", "yaw_per_mm")
"""What `ScaleEvidence.values` are: the logarithm of true elevational distance over the images', and the
turning about x and y per true mm travelled that the images lack, rad/mm."""


@dataclass(frozen=True)
class ScaleEvidence:
    """Likelihood of the images' common errors along a sweep by one source, without any prior.

    Attributes
    ----------
    source : str
        "crossing".
    values : ndarray, shape (3,)
        Most likely `TERMS`, means over the sweep.
    information : ndarray, shape (3, 3)
        Inverse of their covariance; zero for what the source does not tell.
    """

    source: str
    values: FloatArray
    information: FloatArray


@shown
@dataclass(frozen=True)
class ScaledPoses:
    """Poses whose length comes from a source other than the images.

    Attributes
    ----------
    poses : RigidTransform, length n
        ``world_from_image`` of every frame.
    covariance : ndarray, shape (n, 6, 6)
        Of (x, y, z, tilt, yaw, roll) about the image's centre against the first frame, along its axes, mm and
        rad.
    log_scale, log_scale_sigma : float
        Logarithm of the corrected length over the images' own, and its standard deviation.
    evidence : tuple of ScaleEvidence
        What it rests on beside the images.
    details : dict of str to float or str
        For tables and reports.
    """

    poses: RigidTransform
    covariance: FloatArray
    log_scale: float
    log_scale_sigma: float
    evidence: tuple[ScaleEvidence, ...] = ()
    details: dict[str, float | str] = field(default_factory=dict)

    @property
    def length_sigma(self) -> float:
        """Relative standard deviation of the length."""
        return self.log_scale_sigma

    @property
    def scale(self) -> float:
        """Corrected length over the images' own."""
        return float(np.exp(self.log_scale))


@shown
@dataclass(frozen=True)
class FusedPoses(ScaledPoses):
    """Poses of mode `fused`.

    Attributes
    ----------
    used : tuple of str
        "images" and what else took part: "tracker", "orientation sensor", "crossing".
    sizes : dict of str to float
        Jitter found of the sensors: "tracker jitter" in mm, "orientation sensor jitter" in rad.
    """

    used: tuple[str, ...] = ()
    sizes: dict[str, float] | None = None
