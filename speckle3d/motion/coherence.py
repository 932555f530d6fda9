"""Scale of all distances, and how the echo of each patch departs from fully developed speckle's.

Tissue holds structure that stays correlated longer than speckle. Read with a phantom's curve, its echoes say
that the probe hardly moved. With r the amplitude correlation of fully developed speckle, sqrt(rho_F), a patch
whose echo is speckle and a share c of structure has

    rho(d) = gain ((1 - c) r(s d) + c r(s d)^a)^2,    0 <= c < 1, 0 <= a < 1,

where the gain is what electronic noise leaves, a = 0 stands for structure that does not change and a near 1
for structure hardly longer than speckle, and s is what the distances of the path are still to be multiplied
by. Each patch is fitted over the whole sweep, and s is the median over all patches: no patch is judged to
hold structure or not. Its standard deviation comes from the scatter of the rows of patches, since structure
lies in layers. Near d = 0 only s^2 (1 - c (1 - a)) is observable, and structure and scale part by the shape
where r < 0.5 alone: over tissue some 2 % of the scale stay open.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.stats import theilslopes

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.shown import shown
from speckle3d.kernels.plane_misfit import Levers
from speckle3d.kernels.statistics import INTERPOLATION, correlation_variance
from speckle3d.matching.patches import PatchGrid
from speckle3d.motion.distances import WELL_FALLEN, EchoModel

CURVES_SIGMA = 0.002
"""Relative error of all distances that curves from some twenty independent blocks of phantom have."""
PIECE_MM = 10.0
"""Travel over which a patch's echo is taken as alike: less does not part structure from scale (12 mm of
tissue fitted in halves read 1 % longer), more would outlast the tissue's layers."""
NOISY_GAIN = 0.9
"""Part of the correlation that noise leaves, below which a row is noisy: speckle looks finer, structure
unsure."""
LEAST_SHARE = 1e-4
"""Root mean square share that stands for none."""
ROW_SIGMA, PRIOR_ROWS = 0.06, 10
"""Scatter of the scales that rows of patches ask for over tissue, and how many rows of the sweep's own it
counts: simulated tissue of two physics has 0.04 to 0.09, the scatter of 13 rows is known to a third."""
NO_STRUCTURE = 0.02
"""Mean share, over rows of patches, below which all speckle is taken as fully developed: simulated phantoms
have 0.000 to 0.006, tissue 0.05 to 0.14."""
LEAST_GAIN = 0.5
"""Part of the correlation that noise leaves from which a patch counts for the scale: with less it is noise
for the most part. Sweeps without such patches do not depend on it; halved, it moves the length over tissue by
2 % where attenuation leaves noise at depth, and by 3.5 % under a shadow."""
LEAST_BINS = 4
"""Distances at which a patch must have been seen to tell its own scale, gain and structure: as many as these
and the structure's power are."""
_BIN_EDGES_MM = np.concatenate([np.arange(0.0, 1.0, 0.03), np.arange(1.0, 4.01, 0.15)])
"""Fine where the curves fall, coarse where only structure is left."""
MOST_SHARE, MOST_POWER = {"echo": 0.5, "intensity": 0.95}, 0.9
"""Bounds of c, by what is correlated, and of a. An echo that is structure for the most part is r^a alone, a
curve of another width, and tells no scale; of intensity, structure's share is larger, because its phase does
not count."""


class CoherenceSettings(BaseModel):
    """Whether structure and noise are adapted to."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    adapt: bool = Field(True, description="Adapt to coherent echoes and noise; false: phantom curves alone.")


@shown
@dataclass(frozen=True)
class Coherence:
    """Share of structure and gain of every patch, by frame, and the error of the scale of all distances.

    Attributes
    ----------
    frame : ndarray, shape (b,)
        Frames at which they are given; linear between them.
    share, gain : ndarray, shape (b, p)
    scale_sigma : float
        Standard deviation of the logarithm of the scale of all distances.
    """

    frame: FloatArray
    share: FloatArray
    gain: FloatArray
    scale_sigma: float

    def models(self, frame: FloatArray | IntArray) -> EchoModel:
        """Echo models of pairs about frames of shape (e,)."""
        at = np.clip(np.asarray(frame, dtype=float), self.frame[0], self.frame[-1])
        before = np.clip(np.searchsorted(self.frame, at, side="right") - 1, 0, max(self.frame.size - 2, 0))
        after = np.minimum(before + 1, self.frame.size - 1)
        width = np.maximum(self.frame[after] - self.frame[before], 1.0)
        part = ((at - self.frame[before]) / width)[:, None]
        share, gain = (
            np.asarray((1 - part) * v[before] + part * v[after], dtype=float) for v in (self.share, self.gain)
        )
        return EchoModel(share, gain)


@dataclass(frozen=True)
class RowScales:
    """Scale that each row of patches asks for, over that of the path.

    Attributes
    ----------
    depth_mm, logarithm, gain, share : ndarray, shape (r,)
        Medians over the patches of a row.
    """

    depth_mm: FloatArray
    logarithm: FloatArray
    gain: FloatArray
    share: FloatArray


class PatchCorrelations:
    """Correlations of each patch, averaged over pairs of like distance, and the curves they are read with.

    Parameters
    ----------
    first, second : ndarray, shape (e,)
        Frames of each pair.
    correlation : ndarray, shape (e, p)
        NaN where a patch has none.
    path : ndarray, shape (n, 2) or (n, 3)
        Elevational position of each frame's centre, and its slopes along x and, if known, y.
    levers : Levers
        What slopes are multiplied by at each patch.
    """

    def __init__(
        self,
        first: IntArray,
        second: IntArray,
        correlation: Float32Array,
        path: FloatArray,
        curves: DecorrelationCurves,
        patches: PatchGrid,
        levers: Levers,
    ) -> None:
        self._first, self._second, self._correlation = first, second, correlation
        self._levers, self._patches = levers, patches
        at = curves.at(patches.centre_mm[:, 1])
        end = at.correlation[:, -1]
        self._floor = np.where(end > WELL_FALLEN, 0.0, end)
        self._amplitude = np.sqrt(np.clip((at.correlation.T - self._floor) / (1 - self._floor), 0.0, 1.0)).T
        self._step_mm = float(curves.distance_mm[1])
        self._cells, self.of_echo = at.cells, curves.key.correlation_of == "echo"
        self._reach_mm = float(curves.distance_mm[-1]) if end.max() > WELL_FALLEN else np.inf
        travel = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path[:, 0])))])
        count = max(1, int(travel[-1] / PIECE_MM))
        edges = np.searchsorted(travel, np.linspace(0, travel[-1], count + 1)[1:-1])
        self._piece = np.searchsorted(edges, (first + second) / 2, side="right")
        self.centres = (np.append(0, edges) + np.append(edges, len(path) - 1)) / 2
        self._patch = np.tile(np.arange(len(patches)), count)
        self._bin(path)

    def _bin(self, path: FloatArray) -> None:
        """Average correlations over pairs of like distance, for every piece of the sweep and patch."""
        moved = np.zeros((self._first.size, 3))
        moved[:, : path.shape[1]] = path[self._second] - path[self._first]
        z, yaw, tilt = moved.T[:, :, None]
        distance = np.hypot(
            z + yaw * self._levers.lateral_mm + tilt * self._levers.lever_mm, tilt * self._levers.spread_mm
        )
        usable = np.isfinite(self._correlation) & (distance <= self._reach_mm)
        bins = _BIN_EDGES_MM.size - 1
        at = np.minimum(np.searchsorted(_BIN_EDGES_MM, distance, side="right") - 1, bins - 1)
        at += bins * (np.arange(len(self._patches)) + len(self._patches) * self._piece[:, None])
        at, shape = at[usable], (self._patch.size, bins)
        sums = [
            np.bincount(at, weights, minlength=self._patch.size * bins).reshape(shape)
            for weights in (None, distance[usable], self._correlation[usable])
        ]
        count = np.maximum(sums[0], 1)
        self._distance, mean = sums[1] / count, sums[2] / count
        floor, cells = self._floor[self._patch, None], self._cells[self._patch, None]
        variance = correlation_variance(np.clip(mean, 0.0, 0.995), cells, self.of_echo) + INTERPOLATION**2
        self._mean = (mean - floor) / (1 - floor)
        self._weight = (1 - floor) * np.sqrt(sums[0] / variance)
        enough = (sums[0] > 0).sum(axis=1) >= LEAST_BINS
        self.determined = enough if enough.any() else np.ones_like(enough)

    def _speckle(self, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Amplitude of speckle at scaled distances, and its derivative by ln scale."""
        position = self._distance * scale / self._step_mm
        cell = np.minimum(position, self._amplitude.shape[1] - 2).astype(int)
        at = cell + self._amplitude.shape[1] * self._patch[:, None]
        low, high = self._amplitude.take(at), self._amplitude.take(at + 1)
        inside = position <= self._amplitude.shape[1] - 1
        value = np.where(inside, low + (position - cell) * (high - low), high)
        return np.maximum(value, 1e-6), np.where(inside, (high - low) * position, 0.0)

    def fit(
        self,
        log_scale: float | None = None,
        most_share: float | None = None,
        most_power: float = 0.0,
        share_sigma: float = np.inf,
    ) -> FloatArray:
        """Fit ln s, gain, c and a of every patch of every piece, shape (q, 4).

        Parameters
        ----------
        log_scale : float, optional
            To which ln s is held; by default each patch tells its own.
        most_share, most_power : float
            Upper bounds of c (`MOST_SHARE` by default) and a.
        share_sigma : float
            Standard deviation of a normal prior of c about zero.
        """
        most_share = MOST_SHARE["echo" if self.of_echo else "intensity"] if most_share is None else most_share
        lowest = np.array([-1.0 if log_scale is None else log_scale, 0.05, 0.0, 0.0])
        highest = np.array([1.0 if log_scale is None else log_scale, 1.2, most_share, most_power])

        def misfit(v: FloatArray) -> tuple[FloatArray, FloatArray]:
            r, slope = self._speckle(np.exp(v[:, :1]))
            gain, share, power = v[:, 1:2], v[:, 2:3], v[:, 3:4]
            long = r**power
            echo = (1 - share) * r + share * long
            by_echo = 2 * gain * echo
            by_scale = by_echo * (1 - share + share * power * long / r) * slope
            by_share, by_power = by_echo * (long - r), by_echo * share * long * np.log(r)
            jacobian = np.stack([by_scale, echo**2, by_share, by_power], axis=-1) * self._weight[..., None]
            left = self._weight * (gain * echo**2 - self._mean)
            prior = np.broadcast_to(np.array([0.0, 0.0, 1 / share_sigma, 0.0]), (len(v), 1, 4))
            return np.append(left, share / share_sigma, axis=1), np.concatenate([jacobian, prior], axis=1)

        start = np.clip([0.0, 0.95, 0.05, 0.1], lowest, highest)
        return bounded_least_squares(misfit, np.tile(start, (self._patch.size, 1)), lowest, highest)

    @property
    def row_depth_mm(self) -> FloatArray:
        """Depth of each row of patches, shape (r,)."""
        return self._patches.row_depth_mm

    def row_medians(self, values: FloatArray) -> FloatArray:
        """Medians of patches' values of shape (q,) over the row and the pieces, shape (r,); NaN of none."""
        by_piece = np.where(self.determined, values, np.nan).reshape(-1, len(self._patches))
        by_row = np.moveaxis(self._patches.rows_of(by_piece), 1, 0)
        return np.array([_median(row) for row in by_row])


def _median(values: FloatArray) -> float:
    """Median of the finite values; NaN of none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")


def bounded_least_squares(
    misfit: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    start: FloatArray,
    lowest: FloatArray,
    highest: FloatArray,
    rounds: int = 30,
    settled: float = 1e-3,
) -> FloatArray:
    """Solve many small bounded least-squares problems at once by Levenberg-Marquardt.

    Parameters
    ----------
    misfit : callable
        From parameters, shape (k, n), to residuals, shape (k, m), and their derivatives, shape (k, m, n).
    start : ndarray, shape (k, n)
    lowest, highest : ndarray, shape (n,)
        Bounds; parameters that press against one stay there.
    rounds, settled : int, float
        Most rounds, and the step that ends them.

    Returns
    -------
    ndarray, shape (k, n)
    """
    x, damping = start.copy(), np.full(len(start), 1e-2)
    left, jacobian = misfit(x)
    cost = (left**2).sum(axis=1)
    diagonal = np.arange(start.shape[1])
    for _ in range(rounds):
        gradient = np.einsum("kmn,km->kn", jacobian, left)
        free = ~(((x <= lowest) & (gradient > 0)) | ((x >= highest) & (gradient < 0)))
        normal = np.einsum("kmn,kmo->kno", jacobian, jacobian) * (free[:, :, None] & free[:, None, :])
        normal[:, diagonal, diagonal] *= 1 + damping[:, None]
        normal[:, diagonal, diagonal] += np.where(free, 1e-12, 1.0)
        step = -np.linalg.solve(normal, np.where(free, gradient, 0.0)[:, :, None])[:, :, 0]
        trial = np.clip(x + step, lowest, highest)
        trial_left, trial_jacobian = misfit(trial)
        trial_cost = (trial_left**2).sum(axis=1)
        better = trial_cost <= cost
        moved = np.abs(trial - x).max(axis=1)
        x[better], cost[better] = trial[better], trial_cost[better]
        left[better], jacobian[better] = trial_left[better], trial_jacobian[better]
        damping = np.where(better, damping / 5, damping * 4)
        if (moved < settled).all():
            break
    return x


def scale_sigma(coherence: Coherence | None) -> float:
    """Relative standard deviation of the scale of all distances; the curves' own without adaptation."""
    return CURVES_SIGMA if coherence is None else coherence.scale_sigma


def estimate_coherence(correlations: PatchCorrelations) -> tuple[Coherence, float, RowScales]:
    """Estimate shares of structure, gains, and the factor that distances along the path are still to get.

    Structure of an echo turns its phase, so that it decays with some power of speckle's coherence; of
    intensity, which has no phase, shapes with and without decay fit alike: the mean of both scales is taken,
    and what lies between them is claimed.

    Returns
    -------
    Coherence
    float
        True distances over those of the path, median over the patches.
    RowScales
    """
    frozen = correlations.fit()
    typical = float(np.nanmean(correlations.row_medians(frozen[:, 2])))
    if typical < NO_STRUCTURE:
        fits = [correlations.fit(most_share=0.0)]
    elif correlations.of_echo:
        fits = [correlations.fit(most_power=MOST_POWER)]
    else:
        fits = [frozen, correlations.fit(most_power=MOST_POWER)]
    # Where noise is most of the correlation, its course tells nothing of the scale.
    clear = correlations.determined & (frozen[:, 1] >= LEAST_GAIN)
    medians = [_median(fit[clear if clear.any() else correlations.determined, 0]) for fit in fits]
    log_scale, pieces = float(np.mean(medians)), correlations.centres.size
    share_gain = correlations.fit(log_scale, share_sigma=max(typical, LEAST_SHARE))[:, [2, 1]]
    # Patches that tell nothing are taken for the sweep's typical ones.
    share_gain[~correlations.determined] = [
        _median(column) for column in share_gain[correlations.determined].T
    ]
    share, gain = share_gain.T
    rows = RowScales(
        correlations.row_depth_mm,
        correlations.row_medians(np.mean(fits, axis=0)[:, 0]) - log_scale,
        correlations.row_medians(gain),
        correlations.row_medians(share),
    )
    # Standard error of a median of rows, by their median absolute deviation from a line: tilt makes one.
    finite = np.isfinite(rows.logarithm)
    logarithm, depth = rows.logarithm[finite], rows.depth_mm[finite]
    spread = ROW_SIGMA
    if logarithm.size > 2:
        line = theilslopes(logarithm, depth)
        spread = 1.4826 * float(np.median(np.abs(logarithm - line.intercept - line.slope * depth)))
    if typical >= NO_STRUCTURE:
        count = logarithm.size
        spread = np.sqrt((count * spread**2 + PRIOR_ROWS * ROW_SIGMA**2) / (count + PRIOR_ROWS))
    errors = 1.2533 * spread / np.sqrt(logarithm.size), np.ptp(medians) / np.sqrt(12.0), CURVES_SIGMA
    sigma = float(np.linalg.norm(errors))
    return (
        Coherence(correlations.centres, share.reshape(pieces, -1), gain.reshape(pieces, -1), sigma),
        float(np.exp(log_scale)),
        rows,
    )
