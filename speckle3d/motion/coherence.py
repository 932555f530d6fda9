"""Estimate the scale of distances and each patch's share of coherent structure.

Tissue holds structure that stays correlated longer than speckle. Read with a phantom's curve, its echoes say
that the probe hardly moved. With r the amplitude correlation of fully developed speckle, sqrt(rho_F), a patch
whose echo is speckle and a share c of structure has

    rho(d) = gain ((1 - c) r(s d) + c r(s d)^a)^2,    0 <= c < 1, 0 <= a < 1,

where the gain is what electronic noise leaves, a = 0 stands for structure that does not change and a near 1
for structure hardly longer than speckle, and s is what the distances of the path are still to be multiplied
by. Near d = 0 only s^2 (1 - c (1 - a)) is observable, and structure and scale part by the shape where r < 0.5
alone: a patch in noise, or of few cells, fits as well with a large share and a scale a quarter too large.
What a patch says of s is therefore its likelihood averaged over all shares and powers, and s is the likeliest
for all patches together: no patch is judged to hold structure or not.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.special import log_softmax, logsumexp, softmax

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.text import shown
from speckle3d.kernels.plane_misfit import EchoModels
from speckle3d.kernels.statistics import INTERPOLATION, correlation_variance
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.planes import LEAST_CORRELATION, MotionProblem, fully_developed

PIECE_MM = 10.0
"""Travel over which a patch's echo is taken as alike: less does not part structure from scale (12 mm of
tissue fitted in halves read 1 % longer), more would outlast the tissue's layers."""
NOISY_GAIN = 0.9
"""Part of the correlation that noise leaves, below which a row is noisy: speckle looks finer, structure
unsure."""
ROW_SIGMA = 0.06
"""Scatter of the scales that patches and rows of them ask for: rows of simulated tissue of two physics have
0.04 to 0.09. With half of it lengths of the two are 0.03 % rms worse."""
PHANTOM_SIGMA = 0.15
"""Relative error of distances by a phantom's curves where no patch tells its own scale, as in two frames:
tissue reads 5 to 25 % short with them."""
_BIN_EDGES_MM = np.concatenate([np.arange(0.0, 1.0, 0.03), np.arange(1.0, 4.01, 0.15)])
"""Fine where the curves fall, coarse where only structure is left."""
PAIRS_PER_FACT = 4.0
"""Pairs of like distance per independent one: where the echo is nearly lost they overlap within sqrt(pi)
widths of the curve, where it is nearly whole within half of that; at 2.6 frames per width, 4.6 and 2.5. Over
80 sweeps of two physics and three arrays 2, 4, 6, 8 and 12 leave 1.4, 1.3, 1.2, 1.3 and 1.5 % rms; with 8 the
other physics reads 2 % short, with 2 phased arrays 2 % long."""
LOG_SCALES, POWERS = 0.04 * np.arange(-20, 21), np.linspace(0.0, 0.8, 5)
"""Values of ln s and a that are tried: twice as many move lengths by less than 0.1 %."""
SHARES = np.array([0.0, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.14, 0.19, 0.25, 0.32, 0.4, 0.5])
LARGER_SHARES = [0.65, 0.8, 0.95]
"""Values of c. An echo that is structure for the most part is r^a alone, a curve of another width, and tells
no scale; of intensity, structure's share is larger, because its phase does not count."""


@dataclass(frozen=True)
class RowScales:
    """Distance scale of each row of patches, relative to that of all.

    Attributes
    ----------
    depth_mm, logarithm, gain : ndarray, shape (r,)
        Of its patches together; the gain is their median.
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
    false_turn : ndarray, shape (2,)
        Standard deviation of yaw and tilt per distance that errors of distances feign, rad/mm.
    rows : RowScales or None
        None where too few distances tell them.
    """

    frame: FloatArray
    share: FloatArray
    gain: FloatArray
    scale: float
    scale_sigma: float
    false_turn: FloatArray
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
        In steps of the curves' grid; of fully developed speckle that would fall to zero.
    amplitude : ndarray, shape (q, m)
        Of fully developed speckle, on the curves' grid.
    """

    distance: FloatArray
    mean: FloatArray
    weight: FloatArray
    amplitude: FloatArray

    def log_likelihood(
        self, log_scale: float, powers: FloatArray, share: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Log-likelihood of each patch at its likeliest gain, and that gain, shape (a, q, c).

        Parameters
        ----------
        log_scale : float
            ln s.
        powers : ndarray, shape (a,)
        share : ndarray, shape (c,)
        """
        row, position = np.indices(self.mean.shape)[0], self.distance * np.exp(log_scale)
        amplitude = map_coordinates(self.amplitude, [row, position], order=1, mode="nearest")
        speckle = np.maximum(amplitude, 1e-6)
        structure = np.exp(powers[:, None, None] * np.log(speckle))

        def moment(order: int, weight: FloatArray) -> FloatArray:
            """Weighted sum over bins of a power of (1 - c) r + c r^a, by its binomial, shape (a, q, c)."""
            sums, term = [], np.ones_like(structure)
            for k in range(order + 1):
                at_bins = weight * math.comb(order, k) * speckle ** (order - k)
                sums.append(np.einsum("qb,aqb->aq", at_bins, term))
                term = term * structure
            part = np.arange(order + 1)[:, None]
            return np.stack(sums, axis=2) @ ((1.0 - share) ** (order - part) * share**part)

        product, square = moment(2, self.weight**2 * self.mean), moment(4, self.weight**2)
        # Without an echo there is nothing that noise could have taken.
        tiny = np.finfo(float).tiny
        gain = (np.maximum(product, LEAST_CORRELATION * square) + tiny) / (square + tiny)
        return gain * product - 0.5 * gain**2 * square, gain


def _bin_correlations(
    problem: MotionProblem, table: CorrelationTable, path: FloatArray
) -> tuple[_Binning, FloatArray]:
    """Average correlations over pairs of like distance; returns the middles of the sweep's pieces, too."""
    first, second, correlation = table.first, table.second, table.correlation
    curves, levers, grid = problem.at_patches, problem.levers, problem.curves.distance_mm
    travel = np.append(0.0, np.cumsum(np.abs(np.diff(path[:, 0]))))
    pieces = max(1, int(travel[-1] / PIECE_MM))
    ends = np.searchsorted(travel, np.linspace(0, travel[-1], pieces + 1))
    z, yaw, tilt = (path[second] - path[first]).T[:, :, None]
    along = z + yaw * levers.lateral_mm + tilt * levers.lever_mm
    distance = np.hypot(along, tilt * levers.spread_mm)
    usable = np.isfinite(correlation) & (distance <= grid[-1])
    patch_count, bin_count = correlation.shape[1], _BIN_EDGES_MM.size - 1
    at = np.digitize(distance, _BIN_EDGES_MM[1:-1])
    piece = np.digitize((first + second) / 2, ends[1:-1])
    at = (at + bin_count * (np.arange(patch_count) + patch_count * piece[:, None]))[usable]
    count, by_distance, by_correlation = (
        np.bincount(at, weights, pieces * patch_count * bin_count).reshape(-1, bin_count)
        for weights in (None, distance[usable], correlation[usable])
    )
    counts = np.maximum(count, 1)
    mean = by_correlation / counts
    floor = (curves.amplitude[:, -1:] ** 2) * (problem.end_amplitude[:, None] == 0.0)
    amplitude = np.sqrt(np.clip((curves.amplitude**2 - floor) / (1 - floor), 0.0, 1.0))
    floor, cells = np.tile(floor, (pieces, 1)), np.tile(curves.cells, pieces)[:, None]
    variance = correlation_variance(np.clip(mean, 0.0, 0.995), cells, curves.of_echo) + INTERPOLATION**2
    variance *= PAIRS_PER_FACT
    some = count.any(axis=0)
    binning = _Binning(
        (by_distance / counts / curves.step_mm)[:, some],
        ((mean - floor) / (1 - floor))[:, some],
        ((1 - floor) * np.sqrt(count / variance))[:, some],
        np.tile(amplitude, (pieces, 1)),
    )
    return binning, (ends[1:] + ends[:-1]) / 2


def estimate_coherence(problem: MotionProblem, table: CorrelationTable, path: FloatArray) -> Coherence:
    """Estimate shares of structure, gains, and the scale of distances along the path.

    Shares are exponentially distributed, their mean being that of all patches, and all powers alike likely.
    The scales of patches scatter about the common one as Cauchy's distribution has it, of half width
    `ROW_SIGMA`: some are wrong.

    Parameters
    ----------
    path : ndarray, shape (n, 3)
        Elevational position of each frame's centre, and its slopes along x and y.
    """
    binning, centres = _bin_correlations(problem, table, path)
    patches = problem.patches
    as_measured = Coherence(np.zeros(1), *fully_developed(len(patches)), 1.0, PHANTOM_SIGMA, np.ones(2))
    # Scale, gain, share and power are four numbers.
    if (binning.weight > 0.0).sum(axis=1).max() < 4:
        return as_measured
    values = SHARES if problem.at_patches.of_echo else np.append(SHARES, LARGER_SHARES)
    # Curves of tissue hold its structure.
    values = values[:2] if problem.curves.of_tissue else values
    likelihood = np.stack(
        [np.logaddexp.reduce(binning.log_likelihood(scale, POWERS, values)[0]) for scale in LOG_SCALES],
        axis=1,
    )
    log_prior = _share_prior(logsumexp(likelihood, axis=1), values)
    posterior = softmax(logsumexp(likelihood + log_prior, axis=2), axis=1)
    scatter = 1.0 / (1.0 + ((LOG_SCALES - LOG_SCALES[:, None]) / ROW_SIGMA) ** 2)
    log_posterior = np.log(posterior @ (scatter / scatter.sum(axis=0)))
    by_patch = log_posterior.reshape(centres.size, -1, LOG_SCALES.size).sum(axis=0).T
    by_row = patches.rows_of(by_patch).sum(axis=2)
    log_scale = _peak(by_patch.sum(axis=1))
    scale_sigma, false_turn = _deviations(problem, by_patch)
    if problem.curves.of_tissue:
        return replace(as_measured, scale_sigma=scale_sigma, false_turn=false_turn)
    (weight,), (gains,) = binning.log_likelihood(log_scale, np.zeros(1), values)
    weight = softmax(weight + log_prior, axis=1)
    share, gain = (v.reshape(centres.size, -1) for v in (weight @ values, (weight * gains).sum(axis=1)))
    # Rows without an echo have neither scale nor gain.
    row_scale = np.where(np.ptp(by_row, axis=0) > 1e-9, [_peak(row) for row in by_row.T], np.nan)
    row_gain = np.median(patches.rows_of(gain), axis=(0, 2)) + 0.0 * row_scale
    rows = RowScales(patches.row_depth_mm, row_scale - log_scale, row_gain)
    # To first order s^2 (1 - c (1 - a)) is observable, and a is open.
    scale_sigma = float(np.hypot(scale_sigma, 0.5 * share.mean() * POWERS.std()))
    return Coherence(centres, share, gain, float(np.exp(log_scale)), scale_sigma, false_turn, rows)


def _share_prior(by_share: FloatArray, share: FloatArray) -> FloatArray:
    """Logarithm of the exponential distribution whose mean is that of all patches' shares, shape (c,).

    Parameters
    ----------
    by_share : ndarray, shape (q, c)
        Log-likelihood of each patch.
    """
    mean, before, width = float(share.mean()), np.inf, np.gradient(share)
    while abs(mean - before) > 1e-6:
        log_prior, before = np.asarray(log_softmax(np.log(width) - share / mean)), mean
        mean = max(float((softmax(by_share + log_prior, axis=1) @ share).mean()), np.finfo(float).tiny)
    return log_prior


def _peak(log_posterior: FloatArray) -> float:
    """Most likely ln s by a parabola through the maximum, clipped to the scales tried."""
    at = int(np.clip(log_posterior.argmax(), 1, LOG_SCALES.size - 2))
    near = slice(at - 1, at + 2)
    bend, slope, _ = np.polyfit(LOG_SCALES[near], log_posterior[near], 2)
    return float(np.clip(-slope / (2.0 * min(bend, -1e-6)), LOG_SCALES[at - 1], LOG_SCALES[at + 1]))


def _deviations(problem: MotionProblem, by_patch: FloatArray) -> tuple[float, FloatArray]:
    """Standard deviations of the scale, and of false yaw and tilt per distance, from the scatter of patches.

    Structure lies in layers, and curves err by depth: the patches of a row err together. So do those of a
    column, below the same tissue, which feigns yaw where vectors are few or spread. The sum of both scatters
    counts what a patch has for itself twice, and is never negative [2]_.

    Parameters
    ----------
    by_patch : ndarray, shape (s, p)
        Logarithm of each patch's posterior.

    References
    ----------
    .. [1] P. J. Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", Proc.
       Fifth Berkeley Symp. Math. Stat. Prob. 1, 1967.
    .. [2] A. C. Cameron, J. B. Gelbach, D. L. Miller, "Robust inference with multiway clustering", Journal of
       Business & Economic Statistics 29(2), 2011.
    """
    posterior = softmax(by_patch, axis=0)
    error = LOG_SCALES @ posterior
    variance = LOG_SCALES**2 @ posterior - error**2
    arm = np.stack([np.ones(error.size), problem.levers.lateral_mm, problem.levers.lever_mm])
    # Where nothing tells yaw and tilt, they are open by a radian per mm.
    loose = np.diag([0.0, 1.0, 1.0])
    inverse = np.linalg.inv(arm / variance @ arm.T + loose)
    # What turning explains is no scatter.
    error -= inverse @ (arm @ (error / variance)) @ arm
    pull = problem.patches.rows_of(arm * error / variance)
    by_row, by_column = pull.sum(axis=2), pull.sum(axis=1)
    for sums in (by_row, by_column):
        count = sums.shape[1]
        # A turn is a slope, and a level beside it, over the rows or the columns.
        loose = loose + sums @ sums.T * (count / max(count - 2, 1))
    turn = np.sqrt(np.diagonal(inverse @ loose @ inverse)[1:])
    # The scale is that of turns as they are taken.
    return float(np.linalg.norm(by_row[0]) / (1.0 / variance).sum()), turn
