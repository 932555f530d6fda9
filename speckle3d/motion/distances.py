"""Correlation to unsigned elevational distance, with its standard deviation, per patch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.kernels.plane_misfit import EchoModels
from speckle3d.kernels.statistics import INTERPOLATION, correlation_variance
from speckle3d.matching.patches import PatchGrid

LEAST_CORRELATION = 0.03
"""A patch that correlates less than this holds no distance at all."""
WELL_FALLEN = 0.1
"""Correlation above which a curve's end is where it was no longer measured, not where it has levelled out."""
TABLE_STEPS = 400
SHARE_ERROR = 0.35
"""Relative error of a coherent share: structure is neither quite frozen nor quite Gaussian."""


@dataclass(frozen=True)
class PatchDistances:
    """Unsigned elevational distance of each patch between the frames of each pair.

    Attributes
    ----------
    distance_mm, sigma_mm : ndarray, shape (e, p)
        NaN where a patch holds no distance.
    """

    distance_mm: FloatArray
    sigma_mm: FloatArray

    def scaled(self, factor: float) -> PatchDistances:
        """Return the same distances multiplied by a factor."""
        return PatchDistances(factor * self.distance_mm, factor * self.sigma_mm)


@dataclass(frozen=True)
class EchoModel:
    """How patches' correlations depart from fully developed speckle's, rho_F, in each pair.

    rho(d) = gain (share + (1 - share) sqrt(rho_F(d)))^2; see `speckle3d.motion.coherence`.

    Attributes
    ----------
    share, gain : ndarray, shape (e, p)
        Or (1, p), if it is the same for all pairs.
    """

    share: FloatArray
    gain: FloatArray

    @classmethod
    def fully_developed(cls, patches: int) -> EchoModel:
        """Return the model of a phantom's speckle, for all pairs."""
        return cls(np.zeros((1, patches)), np.ones((1, patches)))

    def __getitem__(self, pairs: IntArray | BoolArray | slice) -> EchoModel:
        """Return the model of some of the pairs."""
        return self if len(self.gain) == 1 else EchoModel(self.share[pairs], self.gain[pairs])

    def for_kernels(self) -> EchoModels:
        """Return the same with the errors of shares, as kernels take it."""
        return EchoModels(self.share, self.gain, SHARE_ERROR)


class DistanceEstimator:
    """Inverts decorrelation curves at the depths of a sweep's patches.

    Attributes
    ----------
    amplitude : ndarray, shape (p, m)
        sqrt(rho_F) of each patch on a grid of `step_mm`.
    cells : ndarray, shape (p,)
    of_echo : bool
        Whether correlations are of complex echoes.
    tilt : TiltResponse or None
        At the patches.
    end_amplitude : ndarray, shape (p,)
        At the curve's last distance, beyond which nothing is read; 0 if the curve has levelled out by then.
    reach_mm : float
        Up to where the curves were measured.
    """

    def __init__(self, curves: DecorrelationCurves, patches: PatchGrid) -> None:
        here = curves.at(patches.centre_mm[:, 1])
        self.cells, self.of_echo = here.cells, curves.key.correlation_of == "echo"
        self.step_mm, self.reach_mm = float(curves.distance_mm[1]), float(curves.distance_mm[-1])
        self.amplitude = np.ascontiguousarray(np.sqrt(here.correlation))
        self.tilt = here.tilt
        self._grid = curves.distance_mm
        self._rho = np.ascontiguousarray(here.correlation)
        end = here.correlation[:, -1]
        self._least = np.maximum(LEAST_CORRELATION, end)
        self.end_amplitude = np.where(end > WELL_FALLEN, self.amplitude[:, -1], 0.0)
        self._typical = np.median(self.amplitude, axis=0)
        self._slope = -np.gradient(here.correlation, self.step_mm, axis=1)
        self._slope[:, 0] = 0.0
        root = np.sqrt(-np.log(here.correlation))
        self._root_step = root.max() / (TABLE_STEPS - 1)
        roots = np.arange(TABLE_STEPS) * self._root_step
        # sqrt(-ln rho) is nearly straight in distance, so a uniform table of it inverts well.
        self._distance = np.stack([np.interp(roots, row, self._grid) for row in root])

    def distances(
        self, correlation: npt.NDArray[np.floating], model: EchoModel | None = None
    ) -> PatchDistances:
        """Distance and standard deviation for one correlation per pair and patch, shape (e, p)."""
        if model is not None:
            echo = np.sqrt(np.maximum(correlation, 0.0) / model.gain)
            correlation = np.maximum((echo - model.share) / (1 - model.share), 0.0) ** 2
        known = correlation > self._least
        rho = np.where(known, np.minimum(correlation, 0.9999), 1.0).astype(float)
        position = np.sqrt(-np.log(rho)) / self._root_step
        cell = np.minimum(position, TABLE_STEPS - 1.001).astype(int)
        at = cell + TABLE_STEPS * np.arange(rho.shape[-1])
        low, high = self._distance.take(at), self._distance.take(at + 1)
        distance = low + np.minimum(position - cell, 1.0) * (high - low)
        sigma = self.sigma(distance, model)
        return PatchDistances(np.where(known, distance, np.nan), np.where(known, sigma, np.nan))

    def typical_distance(self, amplitude: FloatArray | float) -> FloatArray:
        """Distance at which the median patch's fully developed speckle keeps an amplitude, mm."""
        falling = self._typical[::-1]
        return np.asarray(np.interp(amplitude, falling, self._grid[: self._typical.size][::-1]))

    def typical_correlation(self, distance_mm: FloatArray) -> FloatArray:
        """Median over the patches of fully developed speckle's correlation; 0 where it was not measured."""
        cell = np.rint(distance_mm / self.step_mm).astype(int)
        beyond = np.median(np.where(self.end_amplitude > 0, 0.0, self._rho[:, -1]))
        by_cell = np.append(np.median(self._rho, axis=0), beyond)
        return np.asarray(by_cell[np.minimum(cell, self._grid.size)])

    def sigma(self, distance_mm: FloatArray, model: EchoModel | None = None) -> FloatArray:
        """Standard deviation of distance estimates where true distances are `distance_mm`, shape (e, p).

        From the correlation's variance over N independent cells and the curve's slope. Near zero the slope
        vanishes; there it is the squared distance whose deviation stays finite.
        """
        share, gain = (0.0, 1.0) if model is None else (model.share, model.gain)
        d = np.maximum(np.abs(np.nan_to_num(distance_mm)), 1e-3)
        position = np.minimum(d / self.step_mm, self._grid.size - 2.001)
        cell = position.astype(int)
        at, part = cell + self._grid.size * np.arange(cell.shape[-1]), position - cell
        rho, slope = ((1 - part) * t.take(at) + part * t.take(at + 1) for t in (self._rho, self._slope))
        g = np.sqrt(rho)
        echo = share + (1 - share) * g
        noise = (
            correlation_variance(np.minimum(gain * echo**2, 0.999), self.cells, self.of_echo)
            + INTERPOLATION**2
        )
        misfit = SHARE_ERROR * share * (1 - g) * 2 * echo * gain
        sigma_rho = np.sqrt(noise + misfit**2) * g / np.maximum(gain * echo * (1 - share), 1e-6)
        direct = sigma_rho / np.maximum(slope, 1e-9)
        return np.asarray(np.minimum(direct, np.sqrt(2 * np.minimum(d, self._grid[-1]) * direct)))
