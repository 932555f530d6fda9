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

from dataclasses import dataclass

import numpy as np
from scipy.stats import theilslopes

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.leastsquares import robust_sigma
from speckle3d.core.shown import shown
from speckle3d.kernels.plane_misfit import EchoModels
from speckle3d.kernels.statistics import INTERPOLATION, correlation_variance
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.planes import LEVEL_END, MotionProblem, fully_developed

CURVES_SIGMA = 0.002
"""Relative error of all distances that curves from some twenty independent blocks of phantom have."""
PIECE_MM = 10.0
"""Travel over which a patch's echo is taken as alike: less does not part structure from scale (12 mm of
tissue fitted in halves read 1 % longer), more would outlast the tissue's layers."""
NOISY_GAIN = 0.9
"""Part of the correlation that noise leaves, below which a row is noisy: speckle looks finer, structure
unsure."""
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
PHANTOM_SIGMA = 0.15
"""Relative error of distances by a phantom's curves where no patch tells its own scale, as in two frames:
tissue reads 5 to 25 % short with them."""
_BIN_EDGES_MM = np.concatenate([np.arange(0.0, 1.0, 0.03), np.arange(1.0, 4.01, 0.15)])
"""Fine where the curves fall, coarse where only structure is left."""
ROUNDS, LAST_STEP, DIFFERENCE = 30, 1e-3, 1e-6
"""Most rounds of a fit, the step of its numbers that ends them, and that of derivatives."""
MOST_SHARE, MOST_POWER = {"echo": 0.5, "intensity": 0.95}, 0.9
"""Bounds of c, by what is correlated, and of a. An echo that is structure for the most part is r^a alone, a
curve of another width, and tells no scale; of intensity, structure's share is larger, because its phase does
not count."""


@dataclass(frozen=True)
class RowScales:
    """Scale that each row of patches asks for, over that of the path.

    Attributes
    ----------
    depth_mm, logarithm, gain : ndarray, shape (r,)
        Medians over the patches of a row.
    """

    depth_mm: FloatArray
    logarithm: FloatArray
    gain: FloatArray


@shown
@dataclass(frozen=True)
class Coherence:
    """Share of structure and gain of every patch, by piece of the sweep, and the scale of distances.

    Attributes
    ----------
    frame : ndarray, shape (b,)
        Middles of the pieces.
    share, gain : ndarray, shape (b, p)
    scale : float
        Of all distances over those of the path that they were read from.
    scale_sigma : float
        Standard deviation of its logarithm.
    rows : RowScales or None
        None where too few distances tell them.
    """

    frame: FloatArray
    share: FloatArray
    gain: FloatArray
    scale: float = 1.0
    scale_sigma: float = CURVES_SIGMA
    rows: RowScales | None = None

    def models(self, frame: IntArray) -> EchoModels:
        """Echo models of pairs about frames of shape (e,): those of the nearest piece."""
        piece = np.abs(frame[:, None] - self.frame).argmin(axis=1)
        return EchoModels(self.share[piece], self.gain[piece])


@dataclass(frozen=True)
class _Binning:
    """Correlations of each patch of each piece, averaged over pairs of like distance, and their curves.

    Attributes
    ----------
    distance, mean, weight : ndarray, shape (q, bins)
        Of fully developed speckle that would fall to zero.
    amplitude : ndarray, shape (q, m)
        Of fully developed speckle, on a grid of `step_mm`.
    determined : ndarray of bool, shape (q,)
        Patches seen at enough distances.
    """

    distance: FloatArray
    mean: FloatArray
    weight: FloatArray
    amplitude: FloatArray
    step_mm: float
    determined: BoolArray

    def fit(
        self,
        most_share: float,
        most_power: float = 0.0,
        log_scale: float | None = None,
        sigma: float = np.inf,
    ) -> FloatArray:
        """Fit ln s, gain, c and a of every patch by bounded Levenberg-Marquardt, shape (q, 4).

        Parameters
        ----------
        most_share, most_power : float
            Upper bounds of c and a.
        log_scale : float, optional
            To which ln s is held; by default each patch tells its own.
        sigma : float
            Standard deviation of a normal prior of c about zero.
        """
        low, high = (-1.0, 1.0) if log_scale is None else (log_scale, log_scale)
        lowest, highest = np.array([low, 0.05, 0.0, 0.0]), np.array([high, 1.2, most_share, most_power])
        x = np.tile(np.clip([0.0, 0.95, 0.05, 0.1], lowest, highest), (len(self.mean), 1))
        misfit = self._misfit(x, sigma)
        damping = np.full((len(x), 1), 1e-2)
        for _ in range(ROUNDS):
            steps = DIFFERENCE * np.eye(4)
            jacobian = (
                np.stack([self._misfit(x + step, sigma) - misfit for step in steps], axis=-1) / DIFFERENCE
            )
            gradient = np.einsum("kmn,km->kn", jacobian, misfit)
            free = ~(((x <= lowest) & (gradient > 0)) | ((x >= highest) & (gradient < 0)))
            normal = np.einsum("kmn,kmo->kno", jacobian, jacobian) * (free[:, :, None] & free[:, None, :])
            diagonal = np.einsum("knn->kn", normal)
            diagonal += damping * diagonal + np.where(free, 1e-12, 1.0)
            step = np.linalg.solve(normal, np.where(free, gradient, 0.0)[:, :, None])[:, :, 0]
            trial = np.clip(x - step, lowest, highest)
            trial_misfit = self._misfit(trial, sigma)
            better = (trial_misfit**2).sum(axis=1) <= (misfit**2).sum(axis=1)
            largest_step = np.abs(trial - x).max()
            x[better], misfit[better] = trial[better], trial_misfit[better]
            damping *= np.where(better, 0.2, 4.0)[:, None]
            if largest_step < LAST_STEP:
                break
        return x

    def _misfit(self, x: FloatArray, sigma: float) -> FloatArray:
        """Weighted misfits, and c over its deviation, shape (q, bins + 1)."""
        log_scale, gain, share, power = x.T[:, :, None]
        last = self.amplitude.shape[1] - 1
        position = np.minimum(self.distance * np.exp(log_scale) / self.step_mm, last)
        cell = np.minimum(position, last - 1).astype(int)
        low, high = (np.take_along_axis(self.amplitude, cell + k, axis=1) for k in (0, 1))
        speckle = np.maximum(low + (position - cell) * (high - low), 1e-6)
        echo = (1 - share) * speckle + share * speckle**power
        return np.append(self.weight * (gain * echo**2 - self.mean), share / sigma, axis=1)


def _bin_correlations(
    problem: MotionProblem, table: CorrelationTable, sound: BoolArray, path: FloatArray
) -> tuple[_Binning, FloatArray]:
    """Average correlations over pairs of like distance; returns the middles of the sweep's pieces, too."""
    first, second, correlation = table.first[sound], table.second[sound], table.correlation[sound]
    curves, levers, grid = problem.at_patches, problem.levers, problem.curves.distance_mm
    travel = np.append(0.0, np.cumsum(np.abs(np.diff(path[:, 0]))))
    pieces = max(1, int(travel[-1] / PIECE_MM))
    edges = np.searchsorted(travel, np.linspace(0, travel[-1], pieces + 1)[1:-1])
    motion = np.zeros((first.size, 3))
    motion[:, : path.shape[1]] = path[second] - path[first]
    z, yaw, tilt = motion.T[:, :, None]
    along = z + yaw * levers.lateral_mm + tilt * levers.lever_mm
    distance = np.hypot(along, tilt * levers.spread_mm)
    usable = np.isfinite(correlation)
    if problem.end_amplitude.any():
        usable &= distance <= grid[-1]
    patch_count, bin_count = correlation.shape[1], _BIN_EDGES_MM.size - 1
    at = np.minimum(np.searchsorted(_BIN_EDGES_MM, distance, side="right") - 1, bin_count - 1)
    piece = np.searchsorted(edges, (first + second) / 2, side="right")
    at = (at + bin_count * (np.arange(patch_count) + patch_count * piece[:, None]))[usable]
    count, by_distance, by_correlation = (
        np.bincount(at, weights, pieces * patch_count * bin_count).reshape(-1, bin_count)
        for weights in (None, distance[usable], correlation[usable])
    )
    counts = np.maximum(count, 1)
    mean = by_correlation / counts
    end = curves.amplitude[:, -1] ** 2
    floor = np.where(end > LEVEL_END, 0.0, end)[:, None]
    amplitude = np.sqrt(np.clip((curves.amplitude**2 - floor) / (1 - floor), 0.0, 1.0))
    floor, cells = np.tile(floor, (pieces, 1)), np.tile(curves.cells, pieces)[:, None]
    variance = correlation_variance(np.clip(mean, 0.0, 0.995), cells, curves.of_echo) + INTERPOLATION**2
    # Scale, gain, share and power are four numbers.
    determined = (count > 0).sum(axis=1) >= 4
    binning = _Binning(
        by_distance / counts,
        (mean - floor) / (1 - floor),
        (1 - floor) * np.sqrt(count / variance),
        np.tile(amplitude, (pieces, 1)),
        curves.step_mm,
        determined,
    )
    return binning, (np.append(0, edges) + np.append(edges, len(path) - 1)) / 2


def standard_error(values: FloatArray, prior: int) -> float:
    """Standard error of the median of finite values, by their own scatter and `prior` more of `ROW_SIGMA`."""
    finite = values[np.isfinite(values)]
    count, spread = finite.size, robust_sigma(finite) if finite.size > 2 else ROW_SIGMA
    spread = np.sqrt((count * spread**2 + prior * ROW_SIGMA**2) / max(count + prior, 1))
    return float(1.2533 * spread / np.sqrt(max(count, 1)))


def estimate_coherence(
    problem: MotionProblem, table: CorrelationTable, sound: BoolArray, path: FloatArray
) -> Coherence:
    """Estimate shares of structure, gains, and the factor that distances along the path are still to get.

    Structure of an echo turns its phase, so that it decays with some power of speckle's coherence; of
    intensity, which has no phase, shapes with and without decay fit alike: the mean of both scales is taken,
    and what lies between them is claimed.

    Parameters
    ----------
    sound : ndarray of bool, shape (e,)
        Pairs of the table that count.
    path : ndarray, shape (n, 2) or (n, 3)
        Elevational position of each frame's centre, and its slopes along x and, if known, y.
    """
    binning, centres = _bin_correlations(problem, table, sound, path)
    is_determined, of_echo = binning.determined, problem.at_patches.of_echo
    # Curves of tissue hold its structure.
    if problem.curves.of_tissue or not is_determined.any():
        return Coherence(np.zeros(1), *fully_developed(len(problem.patches)), scale_sigma=PHANTOM_SIGMA)
    most_share = MOST_SHARE["echo" if of_echo else "intensity"]

    static_fit = binning.fit(most_share)
    # Where noise is most of the correlation, its course tells nothing of the scale.
    clear = is_determined & (static_fit[:, 1] >= LEAST_GAIN)
    clear = clear if clear.any() else is_determined

    def row_medians(values: FloatArray) -> FloatArray:
        by_piece = np.where(clear, values, np.nan).reshape(centres.size, -1)
        by_row = np.moveaxis(problem.patches.rows_of(by_piece), 1, 0)
        finite = (row[np.isfinite(row)] for row in by_row)
        return np.array([np.median(row) if row.size else np.nan for row in finite])

    typical = float(np.nanmean(row_medians(static_fit[:, 2])))
    if typical < NO_STRUCTURE:
        most_share = 0.0
    fits = [binning.fit(most_share, MOST_POWER), *([static_fit] if most_share and not of_echo else [])]
    medians = [float(np.median(fit[clear, 0])) for fit in fits]
    log_scale = float(np.mean(medians))
    gain, share = binning.fit(most_share, 0.0, log_scale, max(typical, NO_STRUCTURE))[:, 1:3].T
    # Patches that tell nothing are taken for the sweep's typical ones.
    gain, share = (np.where(is_determined, v, np.median(v[is_determined])) for v in (gain, share))
    patch_scales = np.mean(fits, axis=0)[:, 0] - log_scale
    rows = RowScales(problem.patches.row_depth_mm, row_medians(patch_scales), row_medians(gain))
    # Deviations from a line over depth: tilt makes one.
    finite_rows, line = np.isfinite(rows.logarithm), (0.0, 0.0)
    if finite_rows.sum() > 2:
        line = theilslopes(rows.logarithm[finite_rows], rows.depth_mm[finite_rows])[:2]
    by_row = standard_error(rows.logarithm - np.polyval(line, rows.depth_mm), PRIOR_ROWS if most_share else 0)
    # Of few frames and rows, patches scatter more than structure's layers.
    scatter = patch_scales - np.polyval(line, np.tile(problem.patches.depth_mm, centres.size))
    by_patch = standard_error(scatter[clear], 0)
    errors = max(by_row, by_patch), np.ptp(medians) / np.sqrt(12.0), CURVES_SIGMA
    sigma = float(np.linalg.norm(errors))
    shape = centres.size, -1
    return Coherence(
        centres, share.reshape(shape), gain.reshape(shape), float(np.exp(log_scale)), sigma, rows
    )
