"""In-plane motion of a frame pair from the correlation of its patches at neighbouring lags."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable

from speckle3d.core.arrays import BoolArray, Complex64Array, Float32Array, FloatArray, IntArray
from speckle3d.core.leastsquares import MAD_TO_SIGMA
from speckle3d.core.poses import HELD
from speckle3d.kernels.copying import copy_into
from speckle3d.kernels.correlation import LAGS, cohere_patch, common_window, correlate_patch, phase_ramp
from speckle3d.kernels.elimination import invert_matrix

LEAST_CORRELATION = 0.05
"""Below this at any lag, the logarithm is mostly noise; the parabola is then put through the coefficient."""
PASSES = 2
"""Fits of the motion, by intensity: about the start, and about the first fit. Echoes are then read about the
last: a fit to their own peaks would bias them upward, and distances short (by 0.4 % of tissue)."""
_HUBER, _ROUNDS = 1.5, 3
"""Robust standard deviations at which a patch begins to lose weight, and times that it is weighed anew."""
_NOWHERE = np.iinfo(np.int64).max
_LEAST_PATCHES = 6
"""Patches from which the scatter of shifts about an affine field tells their error."""
_COLLINEAR = 1e-10
"""Determinant of the normal equations over the product of their diagonal, below which patches lie on a line;
on a grid of a hundred by a hundred patches that do not it is above 1e-5."""
_SLOPES = np.array([0.0, 1.0, 1.0, 0.0, 1.0, 1.0]) / HELD[5] ** 2
"""Inverse variance of the field's offsets and slopes, rad^-2, where patches do not tell slopes: of offsets
nothing is known, slopes are those of a hand's roll between two frames."""


class Frame(NamedTuple):
    """Matching data of a frame: usable patches, equalised image and echo, spectrum.

    Attributes
    ----------
    usable : bool, shape (p,)
        Patches that may be matched.
    image : float32, shape (vector, sample)
        Equalised intensity.
    echo : float32, shape (2, vector, sample)
        Real and imaginary parts of the equalised echo; empty where intensity alone is correlated.
    spectrum : complex64
        Of the image, for the coarse search.
    """

    usable: BoolArray
    image: Float32Array
    echo: Float32Array
    spectrum: Complex64Array


class Geometry(NamedTuple):
    """Geometry of patches and rules of matching.

    Attributes
    ----------
    first : int64, shape (p, 2)
    size : int64, shape (2,)
        Vectors and samples.
    design : float64, shape (p, 3)
        One, and the place of the patches' centres from the image's, mm.
    spacing_mm : float64, shape (p, 2)
        Of vectors and samples at each patch.
    turn : float64, shape (p, 2)
        Sine and cosine of the angle of each patch's vectors from the image's y axis.
    step_rad : float
        Between neighbouring vectors; 0 if they are parallel.
    least_overlap : float
        Share of a patch that must still lie in the other image.
    wavenumber_per_mm : float
        Two-way, of the demodulation: what turns in the plane and strain do to the echoes' phase is undone.
    """

    first: IntArray
    size: IntArray
    design: FloatArray
    spacing_mm: FloatArray
    turn: FloatArray
    step_rad: float
    least_overlap: float
    wavenumber_per_mm: float


class Matches(NamedTuple):
    """Correlation and in-plane motion of frame pairs, a row each.

    Attributes
    ----------
    correlation : float64, shape (m, p)
        Of intensity, or the squared magnitude of the complex echo's, at the frame's in-plane shift; NaN where
        a patch left the image or is flat.
    motion : float64, shape (m, 3)
        Displacement of the centre, mm, and roll, rad.
    covariance : float64, shape (m, 3, 3)
        Of `motion`; the identity where it could not be fitted, and is that of the start.
    """

    correlation: FloatArray
    motion: FloatArray
    covariance: FloatArray


@register_jitable(fastmath=False, error_model="numpy")
def _take_logarithms(rho: FloatArray) -> bool:
    """Replace a patch's correlations by their logarithms if all of them carry, and tell whether they do."""
    for k in range(rho.size):
        if rho[k] <= LEAST_CORRELATION:
            return False
    for k in range(rho.size):
        rho[k] = np.log(rho[k])
    return True


@register_jitable(fastmath=False, error_model="numpy")
def _vertex(before: float, at: float, after: float) -> float:
    curvature = before - 2.0 * at + after
    return (before - after) / (2.0 * curvature) if curvature < 0.0 else np.nan


@register_jitable(fastmath=False, error_model="numpy")
def _peak(z: FloatArray, logarithmic: bool) -> tuple[float, float, float]:
    """Sub-sample peak of a patch from parabolas through ln(rho), with its weight."""
    lateral, axial = _vertex(z[0], z[2], z[4]), _vertex(z[1], z[2], z[3])
    if not (abs(lateral) <= 1.5 and abs(axial) <= 1.5):
        return lateral, axial, 0.0
    peak = min(max(np.exp(z[2]) if logarithmic else z[2], 0.0), 0.999)
    # Variance of a peak's place goes as (1 - rho^2) / rho^2 (Walker & Trahey 1995).
    return lateral, axial, peak**2 / (1.0 - peak**2)


@register_jitable(fastmath=False, error_model="numpy")
def _read(z: FloatArray, logarithmic: bool, lateral: float, axial: float) -> float:
    """Correlation a fraction of a lag off the centre, by parabolas through ln(rho) in both directions.

    Speckle's correlation is nearly the product of what it is along either axis.
    """
    t, u = min(max(lateral, -1.0), 1.0), min(max(axial, -1.0), 1.0)
    value = z[2] + t * (z[4] - z[0]) / 2.0 + t * t * ((z[0] + z[4]) / 2.0 - z[2])
    value += u * (z[3] - z[1]) / 2.0 + u * u * ((z[1] + z[3]) / 2.0 - z[2])
    return float(np.exp(value)) if logarithmic else value


@register_jitable(fastmath=False, error_model="numpy")
def _place(geometry: Geometry, field: FloatArray, p: int) -> tuple[float, float]:
    """Shift of a patch across and along its vectors, in vectors and samples."""
    x = y = 0.0
    for k in range(3):
        x += geometry.design[p, k] * field[0, k]
        y += geometry.design[p, k] * field[1, k]
    sine, cosine = geometry.turn[p, 0], geometry.turn[p, 1]
    across, along = cosine * x - sine * y, sine * x + cosine * y
    return across / geometry.spacing_mm[p, 0], along / geometry.spacing_mm[p, 1]


@register_jitable(fastmath=False, error_model="numpy")
def _ramp(geometry: Geometry, field: FloatArray, p: int, across: float) -> tuple[float, float]:
    """Phase that a field adds from vector to vector and from sample to sample of a patch.

    `across` is its shift in vectors. The next vector of a fan has another direction, in which that counts.
    """
    sine, cosine = geometry.turn[p, 0], geometry.turn[p, 1]
    by_x = sine * field[0, 1] + cosine * field[1, 1]
    by_y = sine * field[0, 2] + cosine * field[1, 2]
    pitch, spacing, k = geometry.spacing_mm[p, 0], geometry.spacing_mm[p, 1], geometry.wavenumber_per_mm
    turned = geometry.step_rad * across
    return k * pitch * (cosine * by_x - sine * by_y + turned), k * spacing * (sine * by_x + cosine * by_y)


@register_jitable(fastmath=False, error_model="numpy")
def _median(values: FloatArray) -> float:
    """Median by Hoare's selection, which changes the order of `values`."""
    low, high, middle = 0, values.size - 1, values.size // 2
    while low < high:
        pivot, i, j = values[middle], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        low, high = i if j < middle else low, j if i > middle else high
    before = values[middle] if values.size % 2 else 0.0
    for k in range(0 if values.size % 2 else middle):
        before = max(before, values[k])
    return float(before + values[middle]) / 2.0


@register_jitable(fastmath=False, error_model="numpy")
def _fit(
    geometry: Geometry,
    usable: BoolArray,
    shift: FloatArray,
    weight: FloatArray,
    field: FloatArray,
    covariance: FloatArray,
) -> bool:
    """Fit an affine field, shape (2, 3), to the patches' shifts across and along their vectors, shape (2, p).

    Least squares with Huber weights; either shift has its own robust standard deviation: along vectors it is
    far smaller. Where patches do not determine the slopes (on a line, or few), those of `field` are taken as
    expected, within a hand's roll between two frames. False, and nothing changed, with too few peaks.

    Parameters
    ----------
    usable : bool, shape (p,)
        Patches that could have a peak.
    """
    count = n = 0
    for p in range(weight.size):
        count, n = count + (weight[p] > 0.0), n + usable[p]
    few = n < _LEAST_PATCHES
    if count < (2 if few else _LEAST_PATCHES):
        return False
    # Loops: each expression over whole arrays compiles for a second.
    own, data, terms = np.empty(count), np.empty((2, count)), np.empty((2, count, 6))
    total, normal, n = np.empty((2, count)), np.zeros((3, 3)), 0
    for p in range(weight.size):
        if weight[p] > 0.0:
            own[n], data[0, n], data[1, n] = weight[p], shift[0, p], shift[1, p]
            total[0, n] = total[1, n] = weight[p]
            sine, cosine = geometry.turn[p, 0], geometry.turn[p, 1]
            for k in range(3):
                term = geometry.design[p, k]
                terms[0, n, k], terms[0, n, 3 + k] = cosine * term, -sine * term
                terms[1, n, k], terms[1, n, 3 + k] = sine * term, cosine * term
                for j in range(3):
                    normal[k, j] += weight[p] * term * geometry.design[p, j]
            n += 1
    limit = _COLLINEAR * normal[0, 0] * normal[1, 1] * normal[2, 2]
    determined = invert_matrix(normal) > limit
    scale, before, size = np.ones(2), np.ones(2), np.empty((2, count))
    for i in range(2 if few else 0):
        mean, spread, whole = 0.0, 0.0, 0.0
        for n in range(count):
            mean, whole = mean + own[n] * data[i, n], whole + own[n]
        for n in range(count):
            spread += own[n] * (data[i, n] - mean / whole) ** 2
        scale[i] = np.sqrt(spread / (count - 1)) + 1e-12
    inverse, right, solution = np.empty((6, 6)), np.empty(6), np.empty(6)
    for _ in range(1 if few else _ROUNDS):
        for k in range(6):
            right[k] = 0.0
            for j in range(6):
                inverse[k, j] = 0.0
            if few or not determined:
                inverse[k, k], right[k] = _SLOPES[k], _SLOPES[k] * field[k // 3, k % 3]
        for i in range(2):
            for n in range(count):
                for k in range(6):
                    term = terms[i, n, k] * (total[i, n] / scale[i] ** 2)
                    right[k] += term * data[i, n]
                    for j in range(6):
                        inverse[k, j] += term * terms[i, n, j]
        invert_matrix(inverse)
        for k in range(6):
            solution[k] = 0.0
            for j in range(6):
                solution[k] += inverse[k, j] * right[j]
        for i in range(2):
            before[i] = scale[i]
        for i in range(0 if few else 2):
            for n in range(count):
                off = data[i, n]
                for k in range(6):
                    off -= terms[i, n, k] * solution[k]
                size[0, n] = size[1, n] = abs(off) * np.sqrt(own[n])
            scale[i] = MAD_TO_SIGMA * _median(size[1]) + 1e-12
            for n in range(count):
                total[i, n] = own[n] * (_HUBER / max(size[0, n] / scale[i], _HUBER))
    for i in range(2):
        for j in range(3):
            field[i, j] = solution[3 * i + j]
            for k in range(3):
                covariance[i, j, k] = inverse[3 * i + j, 3 * i + k] * (scale[i] / before[i]) ** 2
    return True


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def match_pair(fixed: Frame, moving: Frame, geometry: Geometry, matches: Matches, row: int) -> None:
    """Find the in-plane motion of a frame against another, and the correlations left at it.

    Parameters
    ----------
    matches : Matches
        With the motion to begin with, right to about a sample; the row is filled.

    References
    ----------
    .. [1] Housden et al., "Subsample interpolation strategies for sensorless freehand 3D ultrasound",
       Ultrasound Med. Biol. 32(12), 2006: sub-sample lateral motion must not read as elevation.
    """
    spacing, size = geometry.spacing_mm, (geometry.size[0], geometry.size[1])
    motion, correlation, patches = matches.motion[row], matches.correlation[row], len(geometry.spacing_mm)
    # Offset and slopes of the lateral and the axial shift.
    field, start, covariance, fitted = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3, 3)), False
    c, s = np.cos(motion[2]), np.sin(motion[2])
    field[0, 0], field[0, 1], field[0, 2] = -c * motion[0] - s * motion[1], c - 1.0, s
    field[1, 0], field[1, 1], field[1, 2] = s * motion[0] - c * motion[1], -s, c - 1.0
    copy_into(start, field)
    turn = phase_ramp(size, 0.0, 0.0)
    lag, rho = np.empty((2, patches), np.int64), np.empty((patches, len(LAGS)))
    shift, weight = np.empty((2, patches)), np.empty(patches)
    usable, logarithmic = np.empty(patches, np.bool_), np.empty(patches, np.bool_)
    for p in range(patches):
        usable[p] = fixed.usable[p] and moving.usable[p]
        lag[0, p], lag[1, p], weight[p], logarithmic[p] = _NOWHERE, _NOWHERE, 0.0, False
        for k in range(len(LAGS)):
            rho[p, k] = np.nan
    of_echo = moving.echo.size > 0
    for turned in range(PASSES + of_echo):
        by_echo = turned == PASSES
        for p in range(patches):
            place = _place(geometry, field, p)
            if by_echo and (p == 0 or geometry.step_rad > 0.0):
                ramp = _ramp(geometry, field, p, place[0])
                turn = phase_ramp(size, ramp[0], ramp[1])
            at = int(np.rint(place[0])), int(np.rint(place[1]))
            if usable[p] and (by_echo or at[0] != lag[0, p] or at[1] != lag[1, p]):
                lag[0, p], lag[1, p] = at
                corner, z = (geometry.first[p, 0], geometry.first[p, 1]), rho[p]
                window = common_window(corner, size, fixed.image.shape, at, geometry.least_overlap)
                if by_echo:
                    cohere_patch(fixed.echo, moving.echo, turn, window, at, z)
                else:
                    correlate_patch(fixed.image, moving.image, window, at, z)
                logarithmic[p] = _take_logarithms(z)
                lateral, axial, weight[p] = _peak(z, logarithmic[p])
                shift[0, p], shift[1, p] = (at[0] + lateral) * spacing[p, 0], (at[1] + axial) * spacing[p, 1]
        if not by_echo:
            fitted = _fit(geometry, usable, shift, weight, field, covariance)
            if not fitted:
                copy_into(field, start)
    for p in range(patches):
        place = _place(geometry, field, p)
        away = place[0] - lag[0, p], place[1] - lag[1, p]
        correlation[p] = _read(rho[p], logarithmic[p], away[0], away[1])
    error = matches.covariance[row]
    for k in range(3):
        for j in range(3):
            error[k, j] = 1.0 if k == j else 0.0
    if fitted:
        # The centre's shift is seen in the second image's axes; its displacement is told in the first's. Roll
        # comes from axial shifts alone. Off focus the wavefront is curved, so a turn in the plane moves
        # speckle laterally about the focus rather than about the probe: lateral shifts understate it by a
        # fifth and more.
        roll = -field[1, 1]
        c, s = np.cos(roll), np.sin(roll)
        motion[0] = s * field[1, 0] - c * field[0, 0]
        motion[1] = -s * field[0, 0] - c * field[1, 0]
        motion[2] = roll
        error[0, 0] = covariance[0, 0, 0]
        for k in range(2):
            for j in range(2):
                error[1 + k, 1 + j] = covariance[1, k, j]
