"""Correlation to unsigned elevational distance, with its standard deviation, per patch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.kernels.statistics import INTERPOLATION, correlation_variance
from speckle3d.matching.patches import PatchGrid

LEAST_CORRELATION = 0.03
"""A patch that correlates less than this holds no distance at all."""
WELL_FALLEN = 0.1
"""Correlation above which a curve's end is where it was no longer measured, not where it has levelled out."""
TABLE_STEPS = 400
SHARE_ERROR = 0.35
"""Relative error of a coherent share: structure is neither quite frozen nor quite Gaussian."""
STRETCH_ERROR = 0.1
"""Relative error of a stretch, which is chosen from steps of a sixth."""


@dataclass(frozen=True)
class PatchDistances:
    """Unsigned elevational distance of each patch between two frames.

    Attributes
    ----------
    distance_mm, sigma_mm : ndarray, shape (p,)
        NaN where a patch holds no distance.
    """

    distance_mm: FloatArray
    sigma_mm: FloatArray


@dataclass(frozen=True)
class EchoModel:
    """How a patch's correlation departs from fully developed speckle's, rho_F, in one pair.

    rho(d) = gain (staying + moving sqrt(rho_F(d / stretch)))^2; see `speckle3d.motion.coherence`.

    Attributes
    ----------
    staying, moving, gain, stretch : ndarray, shape (p,)
    """

    staying: FloatArray
    moving: FloatArray
    gain: FloatArray
    stretch: FloatArray

    @classmethod
    def fully_developed(cls, patches: int) -> EchoModel:
        """Return the model of a phantom's speckle."""
        one = np.ones(patches)
        return cls(np.zeros(patches), one, one, one)

    def table(self) -> FloatArray:
        """Parameters and the errors of the first and the last, shape (p, 6), as kernels take them."""
        return np.column_stack(
            [
                self.staying,
                self.moving,
                self.gain,
                self.stretch,
                SHARE_ERROR * self.staying,
                np.where(self.stretch > 1.0 + 1e-9, STRETCH_ERROR, 0.0),
            ]
        )


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
        self._rho = here.correlation
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

    def distances(self, correlation: FloatArray, model: EchoModel | None = None) -> PatchDistances:
        """Distance and standard deviation for one correlation per patch, shape (p,)."""
        if model is not None:
            echo = np.sqrt(np.maximum(correlation, 0.0) / model.gain)
            correlation = np.maximum((echo - model.staying) / model.moving, 0.0) ** 2
        rho = np.where(correlation > self._least, np.minimum(correlation, 0.9999), np.nan)
        with np.errstate(invalid="ignore"):
            position = np.sqrt(-np.log(rho)) / self._root_step
        cell = np.clip(np.nan_to_num(position), 0, TABLE_STEPS - 1.001).astype(int)
        patch = np.arange(rho.size)
        low, high = self._distance[patch, cell], self._distance[patch, cell + 1]
        distance = low + np.clip(position - cell, 0, 1) * (high - low)
        if model is not None:
            distance = distance * model.stretch
        return PatchDistances(distance, np.where(np.isnan(rho), np.nan, self.sigma(distance, model)))

    def typical_distance(self, amplitude: float) -> float:
        """Distance at which the median patch's fully developed speckle keeps this amplitude, mm."""
        falling = self._typical[::-1]
        return float(np.interp(amplitude, falling, self._grid[: self._typical.size][::-1]))

    def fully_developed(self, distance_mm: float) -> FloatArray:
        """Correlation of fully developed speckle at one distance, shape (p,); 0 where it was not measured."""
        cell = round(distance_mm / self.step_mm)
        known = self._rho[:, min(cell, self._grid.size - 1)]
        return np.where((cell >= self._grid.size) & (self.end_amplitude > 0), 0.0, known)

    def sigma(self, distance_mm: FloatArray, model: EchoModel | None = None) -> FloatArray:
        """Standard deviation of a distance estimate where the true distance is `distance_mm`, shape (p,).

        From the correlation's variance over N independent cells and the curve's slope. Near zero the slope
        vanishes; there it is the squared distance whose deviation stays finite.
        """
        m = model or EchoModel.fully_developed(self.cells.size)
        d = np.maximum(np.abs(np.nan_to_num(distance_mm)), 1e-3) / m.stretch
        position = np.clip(d / self.step_mm, 0, self._grid.size - 2.001)
        cell = position.astype(int)
        patch, part = np.arange(cell.size), position - cell
        rho, slope = (
            (1 - part) * table[patch, cell] + part * table[patch, cell + 1]
            for table in (self._rho, self._slope)
        )
        _, _, _, _, staying_sd, stretch_sd = m.table().T
        g = np.sqrt(rho)
        echo = m.staying + m.moving * g
        seen = np.minimum(m.gain * echo**2, 0.999)
        noise = np.sqrt(correlation_variance(seen, self.cells, self.of_echo) + INTERPOLATION**2)
        misfit = staying_sd * (1 - g) * 2 * echo * m.gain
        sigma_rho = np.hypot(noise, misfit) * g / np.maximum(m.gain * echo * m.moving, 1e-6)
        d = np.minimum(d, self._grid[-1])
        direct = sigma_rho / np.maximum(slope, 1e-9)
        sigma = np.minimum(direct, np.sqrt(2 * d * direct)) * m.stretch
        return np.asarray(np.hypot(sigma, stretch_sd * d * m.stretch))
