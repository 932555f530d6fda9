"""A calibration as the solver leaves it: the chain, how certain it is, and which frames it stands on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.chain import Chain, ImagePoints, Phantom
from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.leastsquares import Fit


@dataclass(frozen=True)
class Solution:
    """A calibration as the solver leaves it.

    Attributes
    ----------
    chain : Chain
    free : tuple of str, length p
        The parameters estimated, among `CHAIN`.
    fit : Fit
        Of the points used, in frames that lie on the image and on the phantom: there the angles are
        small rotations about the image's z, y and x, wherever the sensor is mounted.
    covariance : ndarray, shape (p, p)
        In the same frames, in the order of `free`; residuals may be correlated within a frame (a sensor's
        error moves all its points) and from frame to frame (it drifts).
    points : ImagePoints
        All that were given.
    used : ndarray of bool, shape (n,)
    residuals : ndarray, shape (n, r)
        Of all points, mm (sines of angles for directions).
    sigma : float
        Robust standard deviation of the residuals of the points used.
    condition_number : float
        Of the scaled Jacobian in the sensor's and the world's own frames, as published (TR 303, Table 2).
    """

    chain: Chain
    phantom: Phantom
    free: tuple[str, ...]
    fit: Fit
    covariance: FloatArray
    points: ImagePoints
    used: BoolArray
    residuals: FloatArray
    sigma: float
    condition_number: float

    @property
    def rms(self) -> float:
        """Root mean square residual of the points used."""
        return float(np.sqrt(np.mean(self.residuals[self.used] ** 2)))

    def image_covariance(self, names: tuple[str, ...]) -> FloatArray:
        """Covariance of some of the parameters, zero for those held."""
        index = [self.free.index(name) if name in self.free else -1 for name in names]
        known = np.array([i >= 0 for i in index])
        picked = self.covariance[np.ix_(index, index)]
        return np.where(np.outer(known, known), picked, 0.0)
