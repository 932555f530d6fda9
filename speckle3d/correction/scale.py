"""Poses whose length comes from other sources than the images, and a crossing sweep's evidence for it."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.text import shown


class ScaleEvidence(NamedTuple):
    """Likelihood of the images' common errors along a sweep by a crossing sweep, without any prior.

    Attributes
    ----------
    values : ndarray, shape (3,)
        Means over the sweep that are most likely: the logarithm of true elevational distance over the
        images', and the turning about x and y per true mm travelled that the images lack, rad/mm.
    information : ndarray, shape (3, 3)
        Inverse of their covariance; zero for what the crossing does not tell.
    """

    values: FloatArray
    information: FloatArray


@shown
@dataclass(frozen=True)
class ScaledPoses:
    """Poses whose length comes from other sources than the images.

    Attributes
    ----------
    poses : RigidTransform, length n
        ``world_from_image`` of every frame.
    covariance : ndarray, shape (n, 6, 6)
        Of (x, y, z, tilt, yaw, roll) about the image's centre against the first frame, along its axes, mm and
        rad.
    log_scale, length_sigma : float
        Logarithm of the corrected length over the images' own, and its standard deviation.
    rests_on : tuple of str
        "images", and of "tracker", "orientation sensor" and "crossing" those that took part.
    evidence : ScaleEvidence or None
        What a crossing sweep alone says.
    details : dict of str to float
        For tables and reports.
    """

    poses: RigidTransform
    covariance: FloatArray
    log_scale: float
    length_sigma: float
    rests_on: tuple[str, ...]
    evidence: ScaleEvidence | None
    details: dict[str, float]

    @property
    def scale(self) -> float:
        """Corrected length over the images' own."""
        return float(np.exp(self.log_scale))
