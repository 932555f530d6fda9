"""Least squares of a calibration's chain: Levenberg and Marquardt's method, all steps in one call."""

import math

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.kernels.chain import PARAMETERS, turned

_SUMS_IN_ANY_ORDER = {"reassoc", "contract", "arcp", "nsz"}

_BLOCK = 64
"""Points worked on together. Components of a block lie so many places apart, which the compiler knows: so it
makes several points at a time of each loop without asking whether arrays overlap."""

_FARTHEST = 100.0
"""Length of the first step at most, in lengths of the scaled parameters."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def fit_chain(
    chain: FloatArray,
    pixels: FloatArray,
    turns: FloatArray,
    shifts: FloatArray,
    rows: FloatArray,
    offsets: FloatArray,
    weights: FloatArray,
    columns: IntArray,
    known: FloatArray,
    tolerance: float,
    most: int,
    found: FloatArray,
) -> tuple[int, bool]:
    """Find the parameters of least squares, in frames that lie on the image and on the phantom.

    The steps and their ends are those of MINPACK's ``lmder``. Its matrix is made of the normal equations,
    which is several times as fast; parameters are scaled, and derivatives that determine them have condition
    numbers far below the 1e7 at which that would tell.

    Parameters
    ----------
    chain : ndarray, shape (2, 4, 4)
        Where the image and the phantom lie: ``sensor_from_image`` and ``target_from_world``.
    pixels, turns, shifts, rows, offsets : ndarray
        As in `chain_residuals`.
    weights : ndarray, shape (n, r)
        Factor on each equation.
    columns : ndarray of int, shape (p,)
        Which of the parameters are free.
    known : ndarray, shape (4,)
        A pixel size, the weight of relative deviations from it as further residuals (zero: none), and
        whether all others then are in the unit of the pixels' rows, not of the phantom (one or zero).
    tolerance : float
        Relative change of the sum of squares and of the scaled parameters at which to stop.
    most : int
        Steps at most.
    found : ndarray, shape (14,)
        Parameters at which to start: pixel sizes, else zero. Replaced by the answer.

    Returns
    -------
    steps : int
        Steps tried; -1 where residuals at the start are not finite.
    converged : bool

    References
    ----------
    .. [1] J. J. More, "The Levenberg-Marquardt algorithm: implementation and theory", 1977.
    """
    free = columns.shape[0]
    points = _placed(chain, pixels, turns, shifts)
    equations = _weighted(rows, offsets, weights)
    slopes = np.empty((PARAMETERS + 4) * _BLOCK)
    now, trial = np.empty((free + 1, free + 1)), np.empty((free + 1, free + 1))
    scale, step, root = np.empty(free), np.empty(free), np.empty((free, free))
    full, row_mm = found.copy(), found[1]
    norm = _normal(found, row_mm, points, equations, columns, known, slopes, now)
    if not norm < math.inf:
        return -1, False
    longest, damping = 0.0, 0.0
    for number in range(most):
        steep = 0.0
        for j in range(free):
            length = math.sqrt(now[j, j])
            if number == 0:
                scale[j] = length if length > 0.0 else 1.0
            scale[j] = max(scale[j], length)
            if length > 0.0 and norm > 0.0:
                steep = max(steep, abs(now[free, j]) / (norm * length))
        size = 0.0
        for j in range(free):
            size += (scale[j] * found[columns[j]]) ** 2
        size = math.sqrt(size)
        if number == 0:
            longest = _FARTHEST * size if size > 0.0 else _FARTHEST
        if steep <= tolerance:
            return number + 1, True
        damping, moved = _step(now, scale, longest, damping, root, step)
        if number == 0:
            longest = min(longest, moved)
        full[:] = found
        for j in range(free):
            full[columns[j]] -= step[j]
        there = _normal(full, row_mm, points, equations, columns, known, slopes, trial)
        fallen = 1.0 - (there / norm) ** 2 if 0.1 * there < norm else -1.0
        linear = 0.0
        for i in range(free):
            for j in range(free):
                linear += step[i] * now[max(i, j), min(i, j)] * step[j]
        linear /= norm * norm
        damped = damping * (moved / norm) ** 2
        promised = linear + 2.0 * damped
        ratio = fallen / promised if promised != 0.0 else 0.0
        if ratio <= 0.25:
            share = 0.5
            if fallen < 0.0:
                share = 0.5 * (linear + damped) / (linear + damped - 0.5 * fallen)
            if 0.1 * there >= norm or share < 0.1:
                share = 0.1
            longest = share * min(longest, 10.0 * moved)
            damping /= share
        elif damping == 0.0 or ratio >= 0.75:
            longest = 2.0 * moved
            damping *= 0.5
        if ratio >= 1e-4:
            found[:] = full
            now, trial = trial, now
            norm = there
            size = 0.0
            for j in range(free):
                size += (scale[j] * found[columns[j]]) ** 2
            size = math.sqrt(size)
        if abs(fallen) <= tolerance and promised <= tolerance and ratio <= 2.0:
            return number + 2, True
        if longest <= tolerance * size:
            return number + 2, True
    return most, False


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def _placed(chain: FloatArray, pixels: FloatArray, turns: FloatArray, shifts: FloatArray) -> FloatArray:
    """Pixels, and poses between the phantom and the image: 14 components, one after another in each block."""
    probe, target = chain[0], chain[1]
    blocks = -(-pixels.shape[0] // _BLOCK)
    placed, half = np.zeros(blocks * 14 * _BLOCK), np.empty((3, 3))
    for k in range(pixels.shape[0]):
        at = k // _BLOCK * 14 * _BLOCK + k % _BLOCK
        placed[at], placed[at + _BLOCK] = pixels[k, 0], pixels[k, 1]
        for i in range(3):
            shift = target[i, 3]
            for j in range(3):
                half[i, j] = (
                    target[i, 0] * turns[k, 0, j]
                    + target[i, 1] * turns[k, 1, j]
                    + target[i, 2] * turns[k, 2, j]
                )
                shift += target[i, j] * shifts[k, j] + half[i, j] * probe[j, 3]
            for j in range(3):
                placed[at + (2 + 3 * i + j) * _BLOCK] = (
                    half[i, 0] * probe[0, j] + half[i, 1] * probe[1, j] + half[i, 2] * probe[2, j]
                )
            placed[at + (11 + i) * _BLOCK] = shift
    return placed


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _weighted(rows: FloatArray, offsets: FloatArray, weights: FloatArray) -> FloatArray:
    """Rows and offsets times their weights, four components in each block, shape (r, blocks * 4 * _BLOCK)."""
    blocks = -(-rows.shape[0] // _BLOCK)
    equations = np.zeros((rows.shape[1], blocks * 4 * _BLOCK))
    for r in range(rows.shape[1]):
        for k in range(rows.shape[0]):
            at = k // _BLOCK * 4 * _BLOCK + k % _BLOCK
            for i in range(3):
                equations[r, at + i * _BLOCK] = weights[k, r] * rows[k, r, i]
            equations[r, at + 3 * _BLOCK] = weights[k, r] * offsets[k, r]
    return equations


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def _normal(
    parameters: FloatArray,
    row_mm: float,
    points: FloatArray,
    equations: FloatArray,
    columns: IntArray,
    known: FloatArray,
    slopes: FloatArray,
    normal: FloatArray,
) -> float:
    """Fill products of the derivatives with each other and, last, with the residuals; return these' norm.

    `slopes`, shape (18 * _BLOCK,), is room for a block's derivatives, residuals and places in the world.
    """
    probe, by_probe = np.empty((3, 3)), np.empty((3, 3, 3))
    target, by_target = np.empty((3, 3)), np.empty((3, 3, 3))
    turned(parameters[5:8], probe, by_probe)
    turned(parameters[11:14], target, by_target)
    sx_mm, sy_mm, shift_x, shift_y, shift_z = parameters[:5]
    in_rows = known[3] != 0.0 and known[2] != 0.0
    shrunk = row_mm / sy_mm if in_rows else 1.0
    by_rows = 1.0 / sy_mm if in_rows else 0.0
    tx, ty, tz = parameters[8:11]
    p00, p01, p10, p11, p20, p21 = (
        probe[0, 0],
        probe[0, 1],
        probe[1, 0],
        probe[1, 1],
        probe[2, 0],
        probe[2, 1],
    )
    free = columns.shape[0]
    normal[:] = 0.0
    out = slopes
    for r in range(equations.shape[0]):
        for block in range(points.shape[0] // (14 * _BLOCK)):
            here = points[block * 14 * _BLOCK : (block + 1) * 14 * _BLOCK]
            rows = equations[r, block * 4 * _BLOCK : (block + 1) * 4 * _BLOCK]
            for k in range(_BLOCK):
                x, y = here[k] * sx_mm, here[_BLOCK + k] * sy_mm
                a = p00 * x + p01 * y + shift_x
                b = p10 * x + p11 * y + shift_y
                c = p20 * x + p21 * y + shift_z
                out[15 * _BLOCK + k] = (
                    here[2 * _BLOCK + k] * a
                    + here[3 * _BLOCK + k] * b
                    + here[4 * _BLOCK + k] * c
                    + here[11 * _BLOCK + k]
                )
                out[16 * _BLOCK + k] = (
                    here[5 * _BLOCK + k] * a
                    + here[6 * _BLOCK + k] * b
                    + here[7 * _BLOCK + k] * c
                    + here[12 * _BLOCK + k]
                )
                out[17 * _BLOCK + k] = (
                    here[8 * _BLOCK + k] * a
                    + here[9 * _BLOCK + k] * b
                    + here[10 * _BLOCK + k] * c
                    + here[13 * _BLOCK + k]
                )
            for k in range(_BLOCK):
                rx, ry, rz = shrunk * rows[k], shrunk * rows[_BLOCK + k], shrunk * rows[2 * _BLOCK + k]
                # The row in the world's axes, then in the sensor's.
                ux = rx * target[0, 0] + ry * target[1, 0] + rz * target[2, 0]
                uy = rx * target[0, 1] + ry * target[1, 1] + rz * target[2, 1]
                uz = rx * target[0, 2] + ry * target[1, 2] + rz * target[2, 2]
                value = (
                    ux * out[15 * _BLOCK + k]
                    + uy * out[16 * _BLOCK + k]
                    + uz * out[17 * _BLOCK + k]
                    - shrunk * rows[3 * _BLOCK + k]
                )
                out[14 * _BLOCK + k] = value + rx * tx + ry * ty + rz * tz
                out[8 * _BLOCK + k], out[9 * _BLOCK + k], out[10 * _BLOCK + k] = rx, ry, rz
                out[2 * _BLOCK + k] = (
                    ux * here[2 * _BLOCK + k] + uy * here[5 * _BLOCK + k] + uz * here[8 * _BLOCK + k]
                )
                out[3 * _BLOCK + k] = (
                    ux * here[3 * _BLOCK + k] + uy * here[6 * _BLOCK + k] + uz * here[9 * _BLOCK + k]
                )
                out[4 * _BLOCK + k] = (
                    ux * here[4 * _BLOCK + k] + uy * here[7 * _BLOCK + k] + uz * here[10 * _BLOCK + k]
                )
            for k in range(_BLOCK):
                sx, sy, sz = out[2 * _BLOCK + k], out[3 * _BLOCK + k], out[4 * _BLOCK + k]
                out[k] = (sx * p00 + sy * p10 + sz * p20) * here[k]
                out[_BLOCK + k] = (sx * p01 + sy * p11 + sz * p21) * here[_BLOCK + k] - out[
                    14 * _BLOCK + k
                ] * by_rows
            for i in range(3):
                d = by_probe[i]
                d00, d01, d10, d11, d20, d21 = d[0, 0], d[0, 1], d[1, 0], d[1, 1], d[2, 0], d[2, 1]
                for k in range(_BLOCK):
                    x, y = here[k] * sx_mm, here[_BLOCK + k] * sy_mm
                    out[(5 + i) * _BLOCK + k] = (
                        out[2 * _BLOCK + k] * (d00 * x + d01 * y)
                        + out[3 * _BLOCK + k] * (d10 * x + d11 * y)
                        + out[4 * _BLOCK + k] * (d20 * x + d21 * y)
                    )
                d = by_target[i]
                e00, e01, e02, e10, e11, e12 = d[0, 0], d[0, 1], d[0, 2], d[1, 0], d[1, 1], d[1, 2]
                e20, e21, e22 = d[2, 0], d[2, 1], d[2, 2]
                for k in range(_BLOCK):
                    wx, wy, wz = out[15 * _BLOCK + k], out[16 * _BLOCK + k], out[17 * _BLOCK + k]
                    out[(11 + i) * _BLOCK + k] = (
                        out[8 * _BLOCK + k] * (e00 * wx + e01 * wy + e02 * wz)
                        + out[9 * _BLOCK + k] * (e10 * wx + e11 * wy + e12 * wz)
                        + out[10 * _BLOCK + k] * (e20 * wx + e21 * wy + e22 * wz)
                    )
            for i in range(free + 1):
                at = (columns[i] if i < free else 14) * _BLOCK
                first = out[at : at + _BLOCK]
                for j in range(i + 1):
                    at = (columns[j] if j < free else 14) * _BLOCK
                    second = out[at : at + _BLOCK]
                    total = 0.0
                    for k in range(_BLOCK):
                        total += first[k] * second[k]
                    normal[i, j] += total
    if known[2] != 0.0:
        for i in range(2):
            value = known[2] * (parameters[i] / known[i] - 1.0)
            normal[free, free] += value * value
            for j in range(free):
                if columns[j] == i:
                    normal[j, j] += (known[2] / known[i]) ** 2
                    normal[free, j] += value * known[2] / known[i]
    return math.sqrt(normal[free, free])


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def _step(
    normal: FloatArray, scale: FloatArray, longest: float, damping: float, root: FloatArray, step: FloatArray
) -> tuple[float, float]:
    """Fill the step, to be subtracted, of about the longest length or less; return damping and length."""
    free = scale.shape[0]
    whole = _solved(normal, scale, 0.0, root, step)
    moved, least = math.inf, 0.0
    if whole:
        moved = _length(step, scale)
        if moved - longest <= 0.1 * longest:
            return 0.0, moved
        least = (moved - longest) / (longest * _steepness(root, scale, step, moved))
    pull = 0.0
    for j in range(free):
        pull += (normal[free, j] / scale[j]) ** 2
    pull = math.sqrt(pull)
    greatest = pull / longest
    if greatest == 0.0:
        greatest = 1e-300 / min(longest, 0.1)
    damping = min(max(damping, least), greatest)
    if damping == 0.0:
        damping = pull / moved if whole else 1e-3 * greatest
    excess = moved - longest
    for number in range(10):
        if damping == 0.0:
            damping = max(1e-300, 1e-3 * greatest)
        if not _solved(normal, scale, damping, root, step):
            least = max(least, damping)
            damping *= 10.0
            continue
        moved = _length(step, scale)
        before, excess = excess, moved - longest
        ended = least == 0.0 and excess <= before and before < 0.0
        if abs(excess) <= 0.1 * longest or ended or number == 9:
            break
        change = excess / (longest * _steepness(root, scale, step, moved))
        if excess > 0.0:
            least = max(least, damping)
        elif excess < 0.0:
            greatest = min(greatest, damping)
        damping = max(least, damping + change)
    return damping, moved


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _solved(
    normal: FloatArray, scale: FloatArray, damping: float, root: FloatArray, step: FloatArray
) -> bool:
    """Fill the root of the damped normal equations (Cholesky) and their solution; False if singular."""
    free = scale.shape[0]
    for i in range(free):
        for j in range(i + 1):
            total = normal[i, j]
            if i == j:
                total += damping * scale[i] * scale[i]
            whole = total
            for k in range(j):
                total -= root[i, k] * root[j, k]
            if i > j:
                root[i, j] = total / root[j, j]
            elif total > 1e-14 * whole:
                root[i, i] = math.sqrt(total)
            else:
                return False
    for i in range(free):
        total = normal[free, i]
        for k in range(i):
            total -= root[i, k] * step[k]
        step[i] = total / root[i, i]
    for i in range(free - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, free):
            total -= root[k, i] * step[k]
        step[i] = total / root[i, i]
    return True


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _length(step: FloatArray, scale: FloatArray) -> float:
    """Length of a step in scaled parameters."""
    total = 0.0
    for j in range(scale.shape[0]):
        total += (scale[j] * step[j]) ** 2
    return math.sqrt(total)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _steepness(root: FloatArray, scale: FloatArray, step: FloatArray, moved: float) -> float:
    """By how much the step shortens with damping, relative to its length."""
    free = scale.shape[0]
    solved, total = np.empty(free), 0.0
    for i in range(free):
        value = scale[i] * scale[i] * step[i] / moved
        for k in range(i):
            value -= root[i, k] * solved[k]
        solved[i] = value / root[i, i]
        total += solved[i] * solved[i]
    return total
