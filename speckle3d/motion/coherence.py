"""Coherent scattering and noise, patch by patch, from the sweep's own correlations.

Tissue holds structures longer than the beam is thick. Their echoes stay while speckle decorrelates, so that
correlation falls to a plateau instead of to nothing, and read with a phantom's curve it says that the probe
hardly moved. Pairs of frames far apart show the plateau directly; pairs close together show what
electronic noise takes away. With a patch's echo the sum of a part that stays (share c of the power) and
fully developed speckle, both Gaussian,

    rho(d) = gain (c h(d) + (1 - c) sqrt(rho_F(d)))^2,

where h falls slowly over the structures' own length. The distances of the pairs are known from fully
developed curves only up to a scale that varies slowly along the sweep; it is the one at which all
patches together are explained best, a coherent share being granted only where it pays for itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.geometry import FloatArray
from speckle3d.kernels.coherence import fit_coherent_shares
from speckle3d.motion.intensity import Float32Array
from speckle3d.motion.patches import IntArray, PatchGrid

COARSE_SCALES = np.geomspace(0.7, 3.0, 12)
FINE_SCALES = np.geomspace(0.85, 1.18, 7)
GAIN_PRECISION = 40.0
"""Of the prior about gain one: a deviation of 0.16, noise some 10 dB below the echo."""


class CoherenceSettings(BaseModel):
    """How coherent scattering is found."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    adapt: bool = Field(True, description="Adapt to coherent echoes and noise; false: phantom curves alone.")
    block_frames: int = Field(30, ge=8, description="Frames over which a patch's share is taken as constant.")
    structure_mm: float = Field(10.0, gt=0, description="Length over which coherent structure changes.")
    evidence: float = Field(
        1.5, ge=0, description="Gain in twice the log-likelihood that grants a patch a share."
    )
    redundancy: float = Field(
        20.0, ge=1, description="Frame pairs per independent piece of information: pairs share frames."
    )


@dataclass(frozen=True)
class Coherence:
    """Coherent share and gain of every patch, by frame.

    Attributes
    ----------
    frame : ndarray, shape (b,)
        Frames at which they are given; linear between them.
    share, gain : ndarray, shape (b, p)
    scale : ndarray, shape (b,)
        True over fully developed distance.
    scale_sigma : float
        Standard deviation of the scale's logarithm over the whole sweep.
    structure_mm : float
    """

    frame: FloatArray
    share: FloatArray
    gain: FloatArray
    scale: FloatArray
    scale_sigma: float
    structure_mm: float

    def at(self, frame: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Share and gain at frames, each of shape (e, p)."""
        return tuple(  # type: ignore[return-value]
            np.stack([np.interp(frame, self.frame, column) for column in values.T], axis=1)
            for values in (self.share, self.gain)
        )


def estimate_coherence(
    first: IntArray,
    second: IntArray,
    correlation: Float32Array,
    position_mm: FloatArray,
    curves: DecorrelationCurves,
    patches: PatchGrid,
    settings: CoherenceSettings | None = None,
) -> tuple[Coherence, FloatArray]:
    """Fit shares, gains and the scale of distances.

    Parameters
    ----------
    first, second : ndarray, shape (e,)
        Frames of each pair; pairs sorted by the second.
    correlation : ndarray, shape (e, p)
    position_mm : ndarray, shape (n,)
        Elevational position of each frame, as fully developed curves have it.

    Returns
    -------
    Coherence
    ndarray, shape (n,)
        Positions, rescaled.
    """
    s = settings or CoherenceSettings()
    problem = _Problem(first, second, correlation, curves, patches, s)
    position = np.asarray(position_mm, dtype=float)
    scale = np.ones(problem.centres.size)
    for scales in (COARSE_SCALES, FINE_SCALES, FINE_SCALES):
        fits = problem.fit(position, scales)
        found, sigma = _best_scale(fits, scales, s.evidence)
        position = _rescale(position, problem.centres, found)
        scale = scale * found
    fits = problem.fit(position, np.ones(1))[:, 0]
    choice = np.argmin(_costs(fits, s.evidence), axis=-1)
    share = np.where(choice == 2, fits[..., 0], 0.0)
    gain = np.choose(choice, [np.ones_like(share), fits[..., 3], fits[..., 1]])
    return Coherence(problem.centres, share, gain, scale, sigma, s.structure_mm), position


class _Problem:
    """Pairs by block of frames, and the curves' amplitudes at the patches."""

    def __init__(
        self,
        first: IntArray,
        second: IntArray,
        correlation: Float32Array,
        curves: DecorrelationCurves,
        patches: PatchGrid,
        settings: CoherenceSettings,
    ) -> None:
        self._first, self._second, self._rho = first, second, correlation
        self._settings = settings
        here = curves.at(patches.centre_mm[:, 1])
        self._amplitude = np.ascontiguousarray(np.sqrt(here.correlation))
        self._cells = here.cells
        self._step = float(curves.distance_mm[1])
        frames = int(second.max()) + 1
        half = settings.block_frames / 2
        count = max(1, round(frames / half) - 1)
        self.centres = np.linspace(min(half, frames / 2), max(frames - half, frames / 2), count)
        self._half = half

    def fit(self, position_mm: FloatArray, scales: FloatArray) -> FloatArray:
        """Fits of every block, shape (block, scale, patch, 6)."""
        distance = np.abs(position_mm[self._second] - position_mm[self._first])
        middle = (self._first + self._second) / 2
        out = np.empty((self.centres.size, scales.size, self._rho.shape[1], 6))
        for block, centre in enumerate(self.centres):
            inside = np.abs(middle - centre) <= self._half
            fit_coherent_shares(
                np.ascontiguousarray(self._rho[inside]),
                distance[inside],
                scales,
                self._amplitude,
                self._step,
                self._cells,
                self._settings.structure_mm,
                self._settings.redundancy,
                GAIN_PRECISION,
                out[block],
            )
        return out


def _costs(fits: FloatArray, evidence: float) -> FloatArray:
    """Costs of phantom speckle, of it with a gain, and of a coherent share with a gain; shape (..., 3)."""
    return np.stack([fits[..., 5], fits[..., 4] + evidence, fits[..., 2] + evidence], axis=-1)


def _best_scale(fits: FloatArray, scales: FloatArray, evidence: float) -> tuple[FloatArray, float]:
    """Scale of each block from the likelihood profile, neighbours helping, and its overall deviation."""
    cost = _costs(fits, evidence).min(axis=-1).sum(axis=2)
    padded = np.pad(cost, ((2, 2), (0, 0)), mode="edge")
    smooth = sum(w * padded[k : k + len(cost)] for k, w in enumerate((1.0, 2.0, 3.0, 2.0, 1.0))) / 3.0
    best = np.array([_vertex(np.log(scales), row) for row in np.asarray(smooth)])
    # Blocks overlap by half, so their costs count twice.
    total = cost.sum(axis=0) / 2
    k = int(np.clip(np.argmin(total), 1, scales.size - 2))
    width = np.log(scales[1] / scales[0])
    curvature = (total[k - 1] - 2 * total[k] + total[k + 1]) / width**2
    return np.exp(best), float(np.sqrt(2 / max(curvature, 1e-6)))


def _vertex(x: FloatArray, cost: FloatArray) -> float:
    """Place of the least cost, by a parabola through the least value and its neighbours."""
    k = int(np.argmin(cost))
    if k in (0, len(x) - 1):
        return float(x[k])
    before, at, after = cost[k - 1 : k + 2]
    return float(x[k] + (x[1] - x[0]) * (before - after) / (2 * (before - 2 * at + after)))


def _rescale(position_mm: FloatArray, centres: FloatArray, scale: FloatArray) -> FloatArray:
    """Multiply the steps between frames by a scale that varies along the sweep."""
    steps = np.diff(position_mm)
    middle = np.arange(steps.size) + 0.5
    return np.concatenate([[0.0], np.cumsum(steps * np.interp(middle, centres, scale))])
