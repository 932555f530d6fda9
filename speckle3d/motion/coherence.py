"""Coherent scattering and noise, patch by patch, from the sweep's own correlations.

Tissue holds structures longer than the beam is thick. Their echoes stay while speckle decorrelates, so that
correlation falls to a plateau instead of to nothing, and read with a phantom's curve it says that the probe
hardly moved. Pairs of frames far apart show the plateau directly; pairs close together show what
electronic noise takes away. With a patch's echo the sum of a part that stays (share c of the amplitude) and
fully developed speckle, both Gaussian,

    rho(d) = gain (c h(d) + (1 - c) sqrt(rho_F(d / stretch)))^2,

where h falls slowly, over the structures' own length. Where scatterers are few it is the beam's width and no
longer its curved wavefront that decorrelates them: the curve is stretched. Nothing scatters faster than
fully developed speckle, so a stretch is never below one.

The distances of the pairs are known from fully developed curves only up to a scale that varies slowly along
the sweep; it is the one at which all patches together are explained best, a departure from fully developed
speckle being granted only where it pays for itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.shown import shown
from speckle3d.core.threads import in_parallel
from speckle3d.kernels.coherence import NO_GAIN, bin_by_distance, fit_echo_models
from speckle3d.kernels.statistics import PatchCurves
from speckle3d.matching.patches import PatchGrid
from speckle3d.motion.distances import WELL_FALLEN, EchoModel

COARSE_SCALES = np.geomspace(0.4, 3.0, 16)
FINE_SCALES = np.geomspace(0.85, 1.18, 7)
FINEST_SCALES = np.geomspace(0.95, 1.053, 5)
LEAST_DEPARTING = 0.02
STRETCHES = np.array([1.0, 1.2, 1.4, 1.7])
"""Of the curve where scatterers are few; beyond, a beam hardly differs from one that stays."""
LENGTHS_MM = np.array([NO_GAIN, 0.0, 4.0, 10.0, 40.0])
"""Of coherent structure; zero for none, and for neither structure nor noise."""
GAIN_PRECISION = 40.0
"""Of the prior about gain one: a deviation of 0.16, noise some 10 dB below the echo."""
CURVES_SIGMA = 0.002
"""Relative error of all distances that curves from some twenty independent blocks of phantom have."""
DEPARTURE_ERROR = 0.165
"""Part of an adaptation - mean share and lost gain - that may be wrong as an error of all distances; measured
on sweeps over simulated tissue and noise, from 3 to 6 % of length."""
_EDGES_MM = np.concatenate([np.arange(0.0, 1.0, 0.03), np.arange(1.0, 4.01, 0.15)])
"""Bins of distance: fine where the curves fall, coarse where only what stays is left."""
_GRAIN = 16
"""Patches whose models are fitted at a time: with all kinds and scales some 0.1 ms each."""


class CoherenceSettings(BaseModel):
    """How coherent scattering is found."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    adapt: bool = Field(True, description="Adapt to coherent echoes and noise; false: phantom curves alone.")
    block_frames: int = Field(30, ge=8, description="Frames over which a patch's echo is taken as alike.")
    evidence: float = Field(
        1.5, ge=0, description="Gain in twice the log-likelihood that grants a patch a share or a stretch."
    )
    redundancy: float = Field(
        20.0, ge=1, description="Frame pairs per independent piece of information: pairs share frames."
    )


@shown
@dataclass(frozen=True)
class Coherence:
    """How the echoes of every patch depart from fully developed speckle, by frame.

    Attributes
    ----------
    frame : ndarray, shape (b,)
        Frames at which they are given; linear between them.
    share, gain, stretch : ndarray, shape (b, p)
    decay_per_mm : ndarray, shape (b, p)
        One over the length of coherent structure.
    scale : ndarray, shape (b,)
        True over fully developed distance.
    scale_sigma : float
        Standard deviation of the scale's logarithm over the whole sweep: from the likelihood, the curves, and
        what the models may lack.
    """

    frame: FloatArray
    share: FloatArray
    gain: FloatArray
    stretch: FloatArray
    decay_per_mm: FloatArray
    scale: FloatArray
    scale_sigma: float

    def models(self, frame: FloatArray, distance_mm: FloatArray) -> EchoModel:
        """Echo models of pairs about given frames and so far apart, both of shape (e,)."""
        at = np.clip(frame, self.frame[0], self.frame[-1])
        before = np.searchsorted(self.frame, at, side="right") - 1
        after, width = (at - self.frame[before])[:, None], np.diff(self.frame)[:, None]
        flat = np.zeros((1, self.share.shape[1]))
        share, gain, stretch, decay = (
            np.concatenate([np.diff(values, axis=0) / width, flat])[before] * after + values[before]
            for values in (self.share, self.gain, self.stretch, self.decay_per_mm)
        )
        staying = share * np.exp(-np.abs(distance_mm)[:, None] * decay)
        return EchoModel(staying, 1 - share, gain, stretch)


@dataclass(frozen=True)
class PairEchoes:
    """Echo models of frame pairs, made when they are asked for: for all pairs of a long sweep they are large.

    Attributes
    ----------
    frame : ndarray, shape (e,)
        About which each pair's echoes are taken.
    distance_mm : ndarray, shape (e,)
        How far apart its frames are.
    """

    coherence: Coherence
    frame: FloatArray
    distance_mm: FloatArray

    def __getitem__(self, pairs: IntArray | BoolArray | slice) -> PairEchoes:
        """Those of some of the pairs."""
        return PairEchoes(self.coherence, self.frame[pairs], self.distance_mm[pairs])

    def followed_by(self, others: PairEchoes) -> PairEchoes:
        """Those of these pairs and of others, by one coherence."""
        return PairEchoes(
            self.coherence,
            np.concatenate([self.frame, others.frame]),
            np.concatenate([self.distance_mm, others.distance_mm]),
        )

    def models(self) -> EchoModel:
        """Models of all of these pairs."""
        return self.coherence.models(self.frame, self.distance_mm)


def scale_sigma(coherence: Coherence | None) -> float:
    """Relative standard deviation of the scale of all distances; the curves' own without adaptation."""
    return CURVES_SIGMA if coherence is None else coherence.scale_sigma


def estimate_coherence(
    first: IntArray,
    second: IntArray,
    correlation: Float32Array,
    path: FloatArray,
    curves: DecorrelationCurves,
    patches: PatchGrid,
    lateral_mm: FloatArray,
    settings: CoherenceSettings | None = None,
    known_scale: bool = False,
) -> tuple[Coherence, FloatArray]:
    """Fit shares, gains, stretches and the scale of distances.

    Parameters
    ----------
    first, second : ndarray, shape (e,)
        Frames of each pair; pairs sorted by the second.
    correlation : ndarray, shape (e, p)
    path : ndarray, shape (n, 2)
        Elevational position of each frame's centre and its slope along x.
    lateral_mm : ndarray, shape (p,)
        Of the patches, from the image's centre.
    known_scale : bool
        Whether the path has about the right scale already, so that only its neighbourhood is searched.

    Returns
    -------
    Coherence
    ndarray, shape (n, 2)
        The path, rescaled.
    """
    s = settings or CoherenceSettings()
    problem = EchoProblem(first, second, correlation, curves, patches, lateral_mm, s)
    path = np.asarray(path, dtype=float)
    scale, sigma = np.ones(problem.centres.size), 0.0
    every, some = (STRETCHES, LENGTHS_MM), (STRETCHES[:1], LENGTHS_MM[[0, 1, 3]])
    evidence = s.evidence
    stages = [(FINE_SCALES, *every), (FINEST_SCALES, *every)]
    for scales, stretches, lengths in stages[:1] if known_scale else [(COARSE_SCALES, *some), *stages]:
        cost, _ = problem.fit(path, scales, stretches, lengths, evidence)
        found, sigma = _best_scale(cost.reshape(*cost.shape[:3], -1).min(axis=-1), scales)
        path = _rescale(path, problem.centres, found)
        scale = scale * found
        evidence = s.evidence + _rarity(cost[:, np.argmin(np.abs(np.log(scales / found.mean())))])
    cost, fitted = problem.fit(path, np.ones(1), *every, evidence)
    return _chosen(problem.centres, cost[:, 0], fitted[:, 0], scale, sigma), path


def _rarity(cost: FloatArray) -> float:
    """Further evidence to ask for where few patches depart, so that some of a phantom's do not by chance.

    Twice the logarithm of the odds against a departure, `cost` being of shape (b, p, k, l).
    """
    departs = cost.reshape(*cost.shape[:2], -1).argmin(axis=-1) > 0
    share = float(np.clip(departs.mean(), LEAST_DEPARTING, 0.5))
    return 2.0 * float(np.log((1.0 - share) / share))


def _chosen(
    centres: FloatArray, cost: FloatArray, fitted: FloatArray, scale: FloatArray, sigma: float
) -> Coherence:
    """Best model of each block and patch; `cost` of shape (b, p, k, l)."""
    blocks, patches = cost.shape[:2]
    k, j = np.unravel_index(cost.reshape(blocks, patches, -1).argmin(axis=-1), cost.shape[2:])
    b, p = np.ogrid[:blocks, :patches]
    share, gain = np.moveaxis(fitted[b, p, k, j], -1, 0)
    length = LENGTHS_MM[j]
    decay = np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)
    departure = DEPARTURE_ERROR * (share.mean() + max(1.0 - gain.mean(), 0.0))
    sigma = float(np.sqrt(sigma**2 + CURVES_SIGMA**2 + departure**2))
    return Coherence(centres, share, gain, STRETCHES[k], decay, scale, sigma)


class EchoProblem:
    """Pairs by block of frames, and the curves' amplitudes at the patches."""

    def __init__(
        self,
        first: IntArray,
        second: IntArray,
        correlation: Float32Array,
        curves: DecorrelationCurves,
        patches: PatchGrid,
        lateral_mm: FloatArray,
        settings: CoherenceSettings,
    ) -> None:
        self._first, self._second, self._rho = first, second, correlation
        self._settings, self._lateral = settings, lateral_mm
        here = curves.at(patches.centre_mm[:, 1])
        self._curves = PatchCurves(
            np.ascontiguousarray(np.sqrt(here.correlation)),
            float(curves.distance_mm[1]),
            here.cells,
            curves.key.correlation_of == "echo",
        )
        ends = here.correlation[:, -1].max() > WELL_FALLEN
        self._reach_mm = float(curves.distance_mm[-1]) if ends else np.inf
        frames = int(second.max()) + 1
        half = settings.block_frames / 2
        count = max(1, round(frames / half) - 1)
        self.centres = np.linspace(min(half, frames / 2), max(frames - half, frames / 2), count)
        self._half = half

    def fit(
        self,
        path: FloatArray,
        scales: FloatArray,
        stretches: FloatArray,
        lengths_mm: FloatArray,
        evidence: float,
    ) -> tuple[FloatArray, FloatArray]:
        """Costs of every block, shape (b, s, p, k, l), penalties included, and shares and gains fitted."""
        bins = self._bins(path)
        shape = (len(bins), scales.size, stretches.size, lengths_mm.size)
        cost, found = np.empty(shape), np.empty((*shape, 2))

        def some(first: int, stop: int) -> None:
            fit_echo_models(
                bins,
                scales,
                stretches,
                lengths_mm,
                self._curves,
                self._settings.redundancy,
                GAIN_PRECISION,
                first,
                stop,
                cost,
                found,
            )

        in_parallel(some, len(bins), _GRAIN)
        cost += evidence * (1.0 * (stretches > 1)[:, None] + (lengths_mm != NO_GAIN))
        blocks = self.centres.size
        cost, found = (each.reshape(blocks, -1, *each.shape[1:]).swapaxes(1, 2) for each in (cost, found))
        return cost, found

    def _bins(self, path: FloatArray) -> FloatArray:
        """Sums over pairs of like distance, patch by patch within each block, shape (b p, bins, 4)."""
        moved = path[self._second] - path[self._first]
        middle = (self._first + self._second) / 2
        bins = np.empty((self.centres.size, self._rho.shape[1], _EDGES_MM.size - 1, 4))
        for block, centre in enumerate(self.centres):
            inside = (np.abs(middle - centre) <= self._half) & (np.abs(moved[:, 0]) <= self._reach_mm)
            offset, slope = moved[inside].T.copy()
            bin_by_distance(self._rho[inside], offset, slope, self._lateral, _EDGES_MM, bins[block])
        return bins.reshape(-1, *bins.shape[2:])

    def cost_of_scales(self, path: FloatArray, scales: FloatArray) -> FloatArray:
        """Twice the negative log-likelihood of each scale for each patch, shape (s, p), whatever stays."""
        cost, _ = self.fit(path, scales, STRETCHES[:1], LENGTHS_MM, self._settings.evidence)
        # Blocks overlap by half, so their costs count twice.
        return np.asarray(cost.min(axis=(-2, -1)).sum(axis=0) / 2)


def _best_scale(cost: FloatArray, scales: FloatArray) -> tuple[FloatArray, float]:
    """Scale of each block from the likelihood profile, neighbours helping, and its overall deviation."""
    cost = cost.sum(axis=2)
    padded = np.pad(cost, ((2, 2), (0, 0)), mode="edge")
    smooth = sum(w * padded[k : k + len(cost)] for k, w in enumerate((1.0, 2.0, 3.0, 2.0, 1.0))) / 3.0
    best = np.array([vertex(np.log(scales), row) for row in np.asarray(smooth)])
    # Blocks overlap by half, so their costs count twice.
    total = cost.sum(axis=0) / 2
    k = int(np.clip(np.argmin(total), 1, scales.size - 2))
    width = np.log(scales[1] / scales[0])
    curvature = (total[k - 1] - 2 * total[k] + total[k + 1]) / width**2
    # A likelihood without curvature leaves the scale anywhere in the range that is searched first.
    anywhere = np.log(COARSE_SCALES[-1] / COARSE_SCALES[0]) / np.sqrt(12.0)
    return np.exp(best), float(min(np.sqrt(2 / max(curvature, 1e-6)), anywhere))


def vertex(x: FloatArray, cost: FloatArray) -> float:
    """Place of the least cost, by a parabola through the least value and its neighbours."""
    k = int(np.argmin(cost))
    if k in (0, len(x) - 1):
        return float(x[k])
    before, at, after = cost[k - 1 : k + 2]
    return float(x[k] + (x[1] - x[0]) * (before - after) / (2 * (before - 2 * at + after)))


def _rescale(path: FloatArray, centres: FloatArray, scale: FloatArray) -> FloatArray:
    """Multiply the steps between frames by a scale that varies along the sweep."""
    steps = np.diff(path, axis=0)
    middle = np.arange(len(steps)) + 0.5
    scaled = steps * np.interp(middle, centres, scale)[:, None]
    return np.concatenate([path[:1], path[0] + np.cumsum(scaled, axis=0)])
