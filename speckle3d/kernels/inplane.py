"""In-plane motion of frame pairs from the correlation of their patches at neighbouring lags."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from speckle3d.core.leastsquares import MAD_TO_SIGMA
from speckle3d.kernels.correlation import buffers, cohere_patch, correlate_patch, turns

LEAST_CORRELATION = 0.05
"""Below this at any lag, the logarithm is mostly noise; the parabola is then put through the coefficient."""
REFERENCES = 8
"""Frames that `match_pairs` is given; the last may be repeated."""
PASSES = 2
"""Fits of the motion: about the start, and about the first fit."""
_HUBER, _ROUNDS = 1.5, 5
_NOWHERE = np.iinfo(np.int64).max
_LEAST_PATCHES = 6
_COLLINEAR = 1e-10
"""Ratio of the least to the largest variance of places below which they lie on a line; on a grid of a hundred
by a hundred patches that do not it is above 1e-5."""


class Geometry(NamedTuple):
    """Where patches lie and how they are read.

    Attributes
    ----------
    first : int64, shape (p, 2)
    size : int64, shape (2,)
        Vectors and samples.
    at_mm : float64, shape (p, 2)
        Of the patches' centres, from the image's.
    spacing_mm : float64, shape (2,)
    least_overlap : float
    of_echo : bool
    wavenumber_per_mm : float
    """

    first: IntArray
    size: IntArray
    at_mm: FloatArray
    spacing_mm: FloatArray
    least_overlap: float
    of_echo: bool
    wavenumber_per_mm: float


class Matches(NamedTuple):
    """What `match_pairs` fills.

    Attributes
    ----------
    correlation : float64, shape (m, p)
    motion : float64, shape (m, 4, 3)
        Displacement of the centre, mm, and roll, rad; in the rows after their covariance, if fitted.
    median : float64, shape (m,)
        Of the correlations that are finite; zero if none is.
    fitted : bool, shape (m,)
        Whether the motion was fitted, not kept from the start.
    """

    correlation: FloatArray
    motion: FloatArray
    median: FloatArray
    fitted: BoolArray


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def select(values: FloatArray, count: int, rank: int) -> float:
    """Value of a rank among the first `count`, which are brought in partial order about it (Hoare, 1961)."""
    low, high = 0, count - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return float(values[rank])


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def finite_median(values: FloatArray, spare: FloatArray) -> float:
    """Median of what is finite; zero if nothing is."""
    count = 0
    for k in range(values.size):
        if np.isfinite(values[k]):
            spare[count] = values[k]
            count += 1
    if count == 0:
        return 0.0
    upper = float(select(spare, count, count // 2))
    if count % 2:
        return upper
    lower = float(spare[0])
    for k in range(1, count // 2):
        lower = max(lower, float(spare[k]))
    return 0.5 * (lower + upper)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _sound(rho: FloatArray) -> bool:
    """Whether a patch's logarithms carry: the corners, which weigh little, may be lower."""
    for k in range(3):  # noqa: SIM110 (compiled; NaN does not count)
        if rho[1, k] <= LEAST_CORRELATION or rho[k, 1] <= LEAST_CORRELATION:
            return False
    return True


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _at_least(value: float) -> float:
    """Value limited from below for its logarithm; NaN stays."""
    return float(LEAST_CORRELATION if value < LEAST_CORRELATION else value)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _vertex(before: float, at: float, after: float) -> float:
    curvature = before - 2.0 * at + after
    return (before - after) / (2.0 * curvature) if curvature < 0.0 else np.nan


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _peak(rho: FloatArray) -> tuple[float, float, float]:
    """Sub-sample peak of a patch from parabolas through ln(rho), and how much it is worth."""
    up, left, at, right, down = rho[0, 1], rho[1, 0], rho[1, 1], rho[1, 2], rho[2, 1]
    if _sound(rho):
        up, left, at, right, down = np.log(up), np.log(left), np.log(at), np.log(right), np.log(down)
    lateral, axial = _vertex(up, at, down), _vertex(left, at, right)
    if not (abs(lateral) <= 1.5 and abs(axial) <= 1.5):
        return lateral, axial, 0.0
    peak = min(max(rho[1, 1], 0.0), 0.999)
    # Variance of a peak's place goes as (1 - rho^2) / rho^2 (Walker & Trahey 1995).
    return lateral, axial, peak**2 / (1.0 - peak**2)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _read(rho: FloatArray, lateral: float, axial: float) -> float:
    """Correlation a fraction of a lag off the centre, by quadratics through ln(rho) in both directions."""
    t, u = min(max(lateral, -1.0), 1.0), min(max(axial, -1.0), 1.0)
    across = (t * (t - 1.0) / 2.0, 1.0 - t * t, t * (t + 1.0) / 2.0)
    along = (u * (u - 1.0) / 2.0, 1.0 - u * u, u * (u + 1.0) / 2.0)
    sound, total = _sound(rho), 0.0
    for i in range(3):
        for j in range(3):
            value = np.log(_at_least(rho[i, j])) if sound else rho[i, j]
            total += across[i] * along[j] * value
    return np.exp(total) if sound else total


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _fill_corners(rho: FloatArray) -> None:
    """Speckle's correlation is nearly the product of what it is along either axis.

    By chance there may be next to none at the centre.
    """
    centre = _at_least(rho[1, 1])
    for i in (0, 2):
        for j in (0, 2):
            rho[i, j] = rho[i, 1] * rho[1, j] / centre


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _normal(at: FloatArray, weight: FloatArray, data: FloatArray, count: int, out: FloatArray) -> None:
    """Sums of the normal equations of offset and slopes, shape (9,)."""
    n = nx = ny = nxx = nxy = nyy = r = rx = ry = 0.0
    for k in range(count):
        w, x, y, d = weight[k], at[0, k], at[1, k], data[k]
        wx, wy = w * x, w * y
        n += w
        nx += wx
        ny += wy
        nxx += wx * x
        nxy += wx * y
        nyy += wy * y
        r += w * d
        rx += wx * d
        ry += wy * d
    out[0], out[1], out[2], out[3], out[4] = n, nx, ny, nxx, nxy
    out[5], out[6], out[7], out[8] = nyy, r, rx, ry


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _invert(sums: FloatArray, out: FloatArray) -> None:
    """Inverse of the symmetric matrix whose upper triangle comes first in `sums`, by its adjugate."""
    a, b, c, d, e, f = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    out[0, 0], out[0, 1], out[0, 2] = d * f - e * e, c * e - b * f, b * e - c * d
    out[1, 1], out[1, 2], out[2, 2] = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * out[0, 0] + b * out[0, 1] + c * out[0, 2]
    for i in range(3):
        for j in range(i, 3):
            out[i, j] /= determinant
            out[j, i] = out[i, j]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _robust_fit(
    at: FloatArray,
    data: FloatArray,
    weight: FloatArray,
    count: int,
    room: FloatArray,
    solution: FloatArray,
    covariance: FloatArray,
) -> None:
    """Weighted least squares for offset and slopes with Huber weights at 1.5 robust standard deviations.

    Parameters
    ----------
    at : float64, shape (2, p)
    data, weight : float64, shape (p,)
        The first `count` are used.
    room : float64, shape (3, p)
    solution, covariance : float64, shape (3,) and (3, 3)
        Filled.
    """
    total, size, sums = room[0], room[1], room[2]
    for k in range(count):
        total[k] = weight[k]
    scale = 0.0
    for _ in range(_ROUNDS):
        _normal(at, total, data, count, sums)
        _invert(sums, covariance)
        for i in range(3):
            solution[i] = covariance[i, 0] * sums[6] + covariance[i, 1] * sums[7] + covariance[i, 2] * sums[8]
        for k in range(count):
            residual = data[k] - (solution[0] + solution[1] * at[0, k] + solution[2] * at[1, k])
            size[k] = abs(residual) * np.sqrt(weight[k])
            total[k] = size[k]
        scale = MAD_TO_SIGMA * select(size, count, count // 2) + 1e-12
        for k in range(count):
            total[k] = weight[k] * (_HUBER / max(total[k] / scale, _HUBER))
    for i in range(3):
        for j in range(3):
            covariance[i, j] *= scale * scale


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _determined(at: FloatArray, count: int) -> bool:
    """Whether there are patches enough, and not all on a line."""
    if count < _LEAST_PATCHES:
        return False
    x = y = xx = xy = yy = 0.0
    for k in range(count):
        x += at[0, k] / count
        y += at[1, k] / count
    for k in range(count):
        dx, dy = at[0, k] - x, at[1, k] - y
        xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
    return xx * yy - xy * xy > _COLLINEAR * (xx + yy) ** 2


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _displaced(x_mm: float, y_mm: float, roll_rad: float, at_mm: FloatArray, out: FloatArray) -> None:
    """Where each place of the first frame is found in the second, less itself."""
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    for p in range(at_mm.shape[0]):
        x, y = at_mm[p, 0] - x_mm, at_mm[p, 1] - y_mm
        out[p, 0] = c * x + s * y - at_mm[p, 0]
        out[p, 1] = c * y - s * x - at_mm[p, 1]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _round(shift: FloatArray, spacing: FloatArray, lag: IntArray, changed: BoolArray) -> bool:
    """Nearest lags, which of them are others than before, and whether any is."""
    some = False
    for p in range(lag.shape[0]):
        v, s = np.int64(np.rint(shift[p, 0] / spacing[0])), np.int64(np.rint(shift[p, 1] / spacing[1]))
        changed[p] = v != lag[p, 0] or s != lag[p, 1]
        some = some or changed[p]
        lag[p, 0], lag[p, 1] = v, s
    return some


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _fit(
    at_mm: FloatArray,
    shift: FloatArray,
    weight: FloatArray,
    room: FloatArray,
    motion: FloatArray,
    field: FloatArray,
) -> bool:
    """Fit an affine field to the patches' shifts; false, and nothing changed, if they do not determine it.

    Parameters
    ----------
    room : float64, shape (8, >= p)
    motion : float64, shape (4, 3)
        The centre's displacement and roll, and their covariance in the rows after.
    field : float64, shape (2, 3)
        Offset and slopes of the lateral and axial shift.
    """
    at, data, total = room[:2], room[2:4], room[4]
    count = 0
    for p in range(weight.size):
        if weight[p] > 0.0:
            at[0, count], at[1, count] = at_mm[p, 0], at_mm[p, 1]
            data[0, count], data[1, count] = shift[p, 0], shift[p, 1]
            total[count] = weight[p]
            count += 1
    if not _determined(at, count):
        return False
    lateral, axial = np.empty((3, 3)), np.empty((3, 3))
    _robust_fit(at, data[0], total, count, room[5:], field[0], lateral)
    _robust_fit(at, data[1], total, count, room[5:], field[1], axial)
    motion[1, 0], motion[1, 1], motion[1, 2] = lateral[0, 0], 0.0, 0.0
    for i in range(2):
        motion[2 + i, 0], motion[2 + i, 1], motion[2 + i, 2] = 0.0, axial[i, 0], axial[i, 1]
    # The centre's shift is seen in the second image's axes; its displacement is told in the first's. Roll
    # comes from axial shifts alone. Off focus the wavefront is curved, so a turn in the plane moves speckle
    # laterally about the focus rather than about the probe: lateral shifts understate it by a fifth and more.
    roll = -field[1, 1]
    c, s = np.cos(roll), np.sin(roll)
    motion[0, 0] = s * field[1, 0] - c * field[0, 0]
    motion[0, 1] = -s * field[0, 0] - c * field[1, 0]
    motion[0, 2] = roll
    return True


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def match_pairs(
    images: tuple[Float32Array, ...],
    echoes: tuple[Float32Array, ...],
    image: Float32Array,
    echo: Float32Array,
    geometry: Geometry,
    matches: Matches,
    begin: int,
    stop: int,
) -> None:
    """Find the in-plane motion of a frame against others, and the correlations left at it.

    Parameters
    ----------
    images, echoes : tuple of `REFERENCES` of float32, shapes (vector, sample) and (2, vector, sample)
        The other frames'; pair ``begin + k`` is that of frame k.
    image, echo : float32
        The frame's. Echoes are not read unless they are correlated.
    matches : Matches
        The motion to begin with in the first row of each `motion`; the rest is filled.
    begin, stop : int
        Pairs to match, at most `REFERENCES`.
    """
    first, size, at_mm, spacing = geometry.first, geometry.size, geometry.at_mm, geometry.spacing_mm
    patches, of_echo, least_overlap = first.shape[0], geometry.of_echo, geometry.least_overlap
    predicted, shift = np.empty((patches, 2)), np.empty((patches, 2))
    weight, room = np.empty(patches), np.empty((8, max(patches, 9)))
    lag, changed = np.empty((patches, 2), np.int64), np.empty(patches, np.bool_)
    rho, field, patch_room = np.empty((patches, 3, 3)), np.empty((2, 3)), buffers(size, 1, 1)
    ramp_rad = np.empty(2)
    for m in range(begin, stop):
        fixed, motion = images[m - begin], matches.motion[m]
        x_mm, y_mm, roll_rad = motion[0, 0], motion[0, 1], motion[0, 2]
        _displaced(x_mm, y_mm, roll_rad, at_mm, predicted)
        for p in range(patches):
            lag[p, 0], lag[p, 1] = _NOWHERE, _NOWHERE
        _round(predicted, spacing, lag, changed)
        fitted = False
        for turn in range(PASSES):
            for p in range(patches):
                if changed[p]:
                    correlate_patch(
                        fixed, image, first[p], size, lag[p], least_overlap, not of_echo, patch_room, rho[p]
                    )
                    lateral, axial, weight[p] = _peak(rho[p])
                    shift[p, 0] = (lag[p, 0] + lateral) * spacing[0]
                    shift[p, 1] = (lag[p, 1] + axial) * spacing[1]
            fitted = _fit(at_mm, shift, weight, room, motion, field)
            if fitted:
                for p in range(patches):
                    for k in range(2):
                        predicted[p, k] = field[k, 0] + field[k, 1] * at_mm[p, 0] + field[k, 2] * at_mm[p, 1]
            # Where intensity is correlated it is read about the lags of the last pass.
            if not of_echo and turn == PASSES - 1:
                break
            if not _round(predicted, spacing, lag, changed):
                break
        if not fitted:
            motion[0, 0], motion[0, 1], motion[0, 2] = x_mm, y_mm, roll_rad
            field[1, 1], field[1, 2] = 0.0, 0.0
        matches.fitted[m] = fitted
        if of_echo:
            for k in range(2):
                ramp_rad[k] = geometry.wavenumber_per_mm * field[1, 1 + k] * spacing[k]
            phase = turns(size, 1, ramp_rad)
            for p in range(patches):
                cohere_patch(
                    echoes[m - begin],
                    echo,
                    first[p],
                    size,
                    lag[p],
                    phase,
                    least_overlap,
                    False,
                    patch_room,
                    rho[p],
                )
                _fill_corners(rho[p])
        for p in range(patches):
            lateral = predicted[p, 0] / spacing[0] - lag[p, 0]
            axial = predicted[p, 1] / spacing[1] - lag[p, 1]
            matches.correlation[m, p] = _read(rho[p], lateral, axial)
        matches.median[m] = finite_median(matches.correlation[m], room[0])
