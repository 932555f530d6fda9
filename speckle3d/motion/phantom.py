"""Decorrelation curves: how the correlation of speckle falls with elevational distance, by depth.

The curves are measured on phantoms moved by known distances. They belong to a probe, its settings and
a patch size; off the elevational focus it is the wavefront's curvature rather than the beam's width that
sets them, so they are measured at each depth and not derived from a beam width.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.interpolate import make_smoothing_spline
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.curves import CurveKey, DecorrelationCurves, SpeckleSize, TiltResponse
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.leastsquares import robust_sigma
from speckle3d.core.sweep import RFSettings, Sweep
from speckle3d.kernels.statistics import correlation_variance
from speckle3d.matching.intensity import two_way_wavenumber
from speckle3d.matching.patches import PatchGrid
from speckle3d.matching.table import CorrelationTable

TILT_ROUNDS = 4
"""Fits of curves and of the response to tilt, each from the other."""
LITTLE_TILT, LITTLE_TILT_MM = 0.1, 0.01
"""Curves are fitted to frames whose turning changes distances by no more than this."""
LEAST_RHO = 0.1
"""Correlation at which curves end: below it a patch of some hundred cells cannot tell distances apart."""
BIN_MM = 0.05
"""Distances are averaged over: exact repeats of a phantom in such steps share one."""
PAIRS_PER_FACT = 20.0
"""Frame pairs per independent piece of information: pairs share frames."""
SURE_MM = 4.0
"""Standard deviation below which a pivot counts as learnt, a fraction of the probe's focal length."""
TURNED_RAD = 1e-5
"""From which frames count as turned: rounding is far below."""


class CurveSettings(BaseModel):
    """How curves are fitted."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    largest_mm: float = Field(2.5, gt=0, description="Largest separation of two phantom frames that is used.")
    terms: int = Field(3, ge=1, le=5, description="Order of -ln(rho) as a polynomial in squared distance.")
    pairs: int = Field(3000, ge=10, description="About how many frame pairs of each phantom sweep are used.")
    same_probe: bool = Field(
        False,
        description="The curves were measured on a phantom with the very probe that the sweep was made with, "
        "not only with one of its model: claimed errors of length then leave out what probes differ by.",
    )


@dataclass(frozen=True)
class PhantomSamples:
    """Correlations seen between phantom frames at known distances.

    Attributes
    ----------
    depth_mm, offset_mm, tilt_rad, correlation : ndarray, shape (n,)
        Of each patch in each pair; the offset is signed as the tilt is.
    pairs : int
        Frame pairs they come from.
    """

    depth_mm: FloatArray
    offset_mm: FloatArray
    tilt_rad: FloatArray
    correlation: FloatArray
    pairs: int


def known_positions(sweep: Sweep) -> tuple[RigidTransform, str]:
    """Poses of a phantom sweep's frames and their source: the stored truth, or the tracker's, smoothed.

    A tracker's jitter is a good part of the distances wanted here. The probe moves more smoothly: a smoothing
    spline, its stiffness from generalised cross-validation, takes the jitter out.

    Raises
    ------
    InsufficientDataError
        If there is neither, or the tracker does not cover every frame.
    """
    if sweep.truth is not None:
        return sweep.truth, "truth"
    if sweep.tracker is None:
        raise InsufficientDataError(
            f"{sweep.name}: expected a phantom sweep with known positions (/truth or /tracker), got neither"
        )
    poses = sweep.tracker.world_from_image(sweep.frame_time_s)
    if len(poses) < 8:
        return poses, "tracker"
    first = poses[0]
    motion = (first.inv() * poses).as_matrix()
    values = np.hstack([motion[:, :3, 3], Rotation.from_matrix(motion[:, :3, :3]).as_rotvec()])
    smooth = np.stack(
        [make_smoothing_spline(sweep.frame_time_s, v)(sweep.frame_time_s) for v in values.T], axis=1
    )
    moved = RigidTransform.from_components(smooth[:, :3], Rotation.from_rotvec(smooth[:, 3:]))
    return first * moved, "tracker"


def phantom_pairs(sweep: Sweep, settings: CurveSettings | None = None) -> IntArray:
    """Choose frame pairs of a phantom sweep that are within the curves' reach, shape (m, 2).

    Raises
    ------
    InsufficientDataError
        If positions are not known, or no frames are near enough to each other.
    """
    s = settings or CurveSettings()
    pairs = _choose_pairs(_separations(known_positions(sweep)[0], sweep.grid.centre_mm), s)
    if not len(pairs):
        raise InsufficientDataError(
            f"{sweep.name}: expected phantom frames closer than {s.largest_mm:g} mm, got none"
        )
    return pairs


def _separations(poses: RigidTransform, centre_mm: FloatArray) -> FloatArray:
    """Elevational distance of each frame's centre from each other's plane, shape (n, n), mm."""
    centres = poses.apply(centre_mm)
    normals = poses.rotation.apply([0.0, 0.0, 1.0])
    return np.asarray(np.abs(np.einsum("ijk,ik->ij", centres[None] - centres[:, None], normals)))


def _choose_pairs(separation: FloatArray, settings: CurveSettings) -> IntArray:
    """Pairs within reach, thinned evenly over separation, shape (m, 2), first before second."""
    first, second = np.triu_indices(len(separation), 1)
    near = separation[first, second] <= settings.largest_mm
    pairs = np.column_stack([first[near], second[near]])
    if len(pairs) <= settings.pairs:
        return pairs
    order = np.argsort(separation[pairs[:, 0], pairs[:, 1]], kind="stable")
    kept = order[np.linspace(0, len(order) - 1, settings.pairs).astype(int)]
    return np.asarray(pairs[np.sort(kept)])


def phantom_samples(
    sweep: Sweep, patches: PatchGrid, table: CorrelationTable, pairs: IntArray
) -> PhantomSamples:
    """Set the correlations of matched phantom frames beside their known distances.

    Parameters
    ----------
    table : CorrelationTable
    pairs : ndarray, shape (m, 2)
        Those of the table that count.
    """
    poses, _ = known_positions(sweep)
    counted = np.isin(table.first * len(poses) + table.second, pairs @ [len(poses), 1])
    first, second, correlation = table.first[counted], table.second[counted], table.correlation[counted]
    normal = (poses[first].inv() * poses[second]).as_matrix()[:, 2]
    at = patches.centre_mm - table.inplane[counted, None, :2]
    offset = (at * normal[:, None, :2]).sum(axis=2) + normal[:, 3:]
    tilt = normal[:, :1] * np.sin(patches.angle_rad) + normal[:, 1:2] * np.cos(patches.angle_rad)
    depth = np.broadcast_to(patches.depth_mm, tilt.shape)
    return PhantomSamples(
        depth.ravel(), offset.ravel(), tilt.ravel(), correlation.ravel().astype(float), len(first)
    )


def phantom_speckle(
    depth_mm: FloatArray, seen: Iterable[tuple[FloatArray, SpeckleSize]]
) -> SpeckleSize | None:
    """Mean speckle size of phantom sweeps at each depth of the curves; None if no depth has any.

    Parameters
    ----------
    depth_mm : ndarray, shape (r,)
    seen : iterable of (ndarray, SpeckleSize)
        Depths of a sweep's rows of patches, and the sizes there, NaN where they are not known.
    """
    some = list(seen)
    depth = np.concatenate([depths for depths, _ in some])
    sizes = []
    for name in ("lateral_mm", "axial_mm"):
        values = np.concatenate([getattr(size, name) for _, size in some])
        known = np.isfinite(values)
        if not known.any():
            return None
        at, mean = _means(np.round(depth[known], 6), depth[known], values[known])
        sizes.append(np.interp(depth_mm, at, mean))
    return SpeckleSize(*sizes)


def _means(label: FloatArray, *values: FloatArray) -> list[FloatArray]:
    """Means of values over those of equal label, in the labels' order."""
    _, group = np.unique(label, return_inverse=True)
    return [np.bincount(group, value) / np.bincount(group) for value in values]


def fit_curves(
    key: CurveKey, samples: Iterable[PhantomSamples], settings: CurveSettings | None = None
) -> DecorrelationCurves:
    """Fit one smooth falling curve per depth to the samples of all phantom sweeps.

    -ln(rho) is a polynomial in squared distance without odd terms, since a beam looks the same from
    either side; its constant is what noise and interpolation cost at no distance at all.

    Raises
    ------
    InsufficientDataError
        If a depth has too few samples over too little of its curve.
    """
    s = settings or CurveSettings()
    every = list(samples)
    if not every:
        raise InsufficientDataError("expected samples of at least one phantom sweep, got none")
    depth, offset, tilt, rho = (
        np.concatenate([getattr(one, name) for one in every])
        for name in ("depth_mm", "offset_mm", "tilt_rad", "correlation")
    )
    rows, grid = np.unique(np.round(depth, 6)), np.linspace(0.0, s.largest_mm, 251)
    at = [np.flatnonzero((np.abs(depth - row) < 1e-5) & np.isfinite(rho)) for row in rows]
    echo, response, distance = key.correlation_of == "echo", None, np.abs(offset)
    wavenumber = two_way_wavenumber(key.signal) if isinstance(key.signal, RFSettings) else 0.0
    fair = np.ones(depth.size, dtype=bool)
    # Turning distorts the curves a little and is itself read from them: estimate both in turn.
    for turn in range(TILT_ROUNDS):
        some = [own[fair[own]] for own in at]
        fitted = [
            _fit_row(row, grid, s.terms, echo, distance[own], rho[own])
            for row, own in zip(rows, some, strict=True)
        ]
        curves, cells, ends = (np.array(part) for part in zip(*fitted, strict=True))
        if turn == TILT_ROUNDS - 1:
            break
        known = [(offset[own], tilt[own], rho[own]) for own in at]
        response = fit_tilt_response(rows, curves, cells, grid, wavenumber, echo, known)
        if response is None:
            break
        here = response.at(depth, rows)
        distance = effective_distance(offset, tilt, here.pivot_mm, here.spread_mm)
        fair = np.abs(distance - np.abs(offset)) <= LITTLE_TILT_MM + LITTLE_TILT * np.abs(offset)
    grid = grid[: max(2, int(np.searchsorted(grid, ends.min(), side="right")))]
    pairs = sum(one.pairs for one in every)
    return DecorrelationCurves(key, rows, grid, curves[:, : grid.size], cells, pairs, response)


def _fit_row(
    depth_mm: float, grid: FloatArray, terms: int, of_echo: bool, distance: FloatArray, rho: FloatArray
) -> tuple[FloatArray, float, float]:
    """Curve of one depth on `grid`, the cells that explain the scatter about it, and its last distance.

    A curve that has fallen as low as can be told goes on; one whose phantom did not go so far ends there.
    """
    centre, mean = _means(np.round(distance / BIN_MM), distance, rho)
    # The fit of in-plane motion finds a little correlation in frames that share no speckle. Curves include
    # it, so that it is not taken for coherent scattering in a sweep.
    low = centre[mean < LEAST_RHO]
    far = mean[centre > 1.5 * low[0]] if low.size else mean[:0]
    floor = float(np.clip(far.mean(), 0.0, LEAST_RHO / 2)) if far.size >= 3 else 0.0
    excess = (mean - floor) / (1 - floor)
    # Where a curve has levelled out it tells no distance: fit what lies before the first bin below the least.
    below = np.flatnonzero(excess < LEAST_RHO)
    stop = int(below[0]) if below.size else mean.size
    centre, excess = centre[:stop], excess[:stop]
    if centre.size < 3 or excess.min() > 0.6:
        raise InsufficientDataError(
            f"curves at {depth_mm:.1f} mm depth: expected phantom frames at 3 or more distances "
            f"over which the correlation falls below 0.6, got {centre.size} "
            f"down to {excess.min() if excess.size else 1:.2f}"
        )
    curve = floor + (1 - floor) * np.exp(-_fitted_fall(grid, centre, excess, min(terms, centre.size - 2)))
    used = distance <= centre[-1]
    expected = np.interp(distance[used], grid, curve)
    cells = 60.0
    for _ in range(4):
        deviation = np.sqrt(correlation_variance(expected, cells, of_echo) + 1e-6)
        cells /= robust_sigma((rho[used] - expected) / deviation) ** 2
    return curve, cells, float(grid[-1] if below.size else centre[-1])


def _fitted_fall(grid: FloatArray, centre: FloatArray, rho: FloatArray, terms: int) -> FloatArray:
    """Rise of -ln(rho) with distance on `grid`: a polynomial in squared distance, then a straight line."""
    reach, powers = centre[-1], 2 * np.arange(terms + 1)
    design, weight = (centre[:, None] / reach) ** powers, rho / (1 - rho**2 + 0.01)
    coefficients = np.linalg.lstsq(design * weight[:, None], -np.log(rho) * weight, rcond=None)[0]
    coefficients[0] = max(coefficients[0], 1e-6)
    fall = (np.minimum(grid, reach)[:, None] / reach) ** powers @ coefficients
    last = int(np.searchsorted(grid, reach, side="right")) - 1
    slope = max((fall[last] - fall[last - 5]) / (grid[1] * 5), 1e-3)
    fall = fall[np.minimum(np.arange(grid.size), last)] + slope * np.maximum(grid - grid[last], 0.0)
    return np.asarray(np.maximum.accumulate(fall + 1e-9 * np.arange(fall.size)))


def effective_distance(
    offset_mm: FloatArray, tilt_rad: FloatArray, pivot_mm: FloatArray | float, spread_mm: FloatArray | float
) -> FloatArray:
    """Distance without tilt at which speckle would have decorrelated as much."""
    return np.asarray(np.hypot(offset_mm - pivot_mm * tilt_rad, spread_mm * tilt_rad))


def fit_tilt_response(
    depths_mm: FloatArray,
    curves: FloatArray,
    cells: FloatArray,
    distance_mm: FloatArray,
    wavenumber_per_mm: float,
    of_echo: bool,
    samples: list[tuple[FloatArray, FloatArray, FloatArray]],
) -> TiltResponse | None:
    """Fit the pivot at each depth to phantom frames that turned; None if they hardly did.

    Spread and pivot cannot be separated while frames turn about the probe's face; the spread is therefore
    that of a Gaussian beam of the curves' own width: two-way wavenumber times width squared.

    Parameters
    ----------
    depths_mm, cells : ndarray, shape (r,)
    curves : ndarray, shape (r, k)
        On `distance_mm`, shape (k,).
    wavenumber_per_mm : float
        Two-way, 4 pi over the wavelength; 0 if it is not known.
    samples : list of r tuples of ndarray
        Signed offset, tilt and correlation at each depth.
    """
    width = np.array([np.interp(0.5, -np.log(curve), distance_mm) for curve in curves])
    spread = wavenumber_per_mm * width**2
    fits = []
    for curve, own, wide, sample in zip(curves, cells / PAIRS_PER_FACT, spread, samples, strict=True):
        turned = (np.abs(sample[1]) > TURNED_RAD) & (np.abs(sample[0]) < distance_mm[-1])
        if turned.sum() < 4 * PAIRS_PER_FACT:
            return None
        offset, tilt, rho = (values[turned] for values in sample)

        def misfit(pivot: FloatArray, *known: FloatArray | float) -> FloatArray:
            offset, tilt, rho, curve, own, wide = known
            at = effective_distance(np.asarray(offset), np.asarray(tilt), pivot[0], wide)
            expected = np.interp(at, distance_mm, np.asarray(curve))
            variance = correlation_variance(np.minimum(expected, 0.98), own, of_echo)
            return np.asarray((rho - expected) / np.sqrt(variance))

        known = offset, tilt, rho, curve, own, wide
        starts = [least_squares(misfit, [x], loss="soft_l1", args=known) for x in (-8.0, 0.0, 8.0)]
        fit = min(starts, key=lambda f: float(f.cost))
        fits.append((float(fit.x[0]), float(1 / np.sqrt(np.square(np.asarray(fit.jac)).sum() + 1e-9))))
    pivot, deviation = np.array(fits).T
    if np.median(deviation) > SURE_MM:
        return None
    # Wavefronts change slowly with depth.
    smooth = np.polynomial.Polynomial.fit(depths_mm, pivot, min(2, depths_mm.size - 1), w=1 / deviation)
    return TiltResponse(smooth(depths_mm), spread)
