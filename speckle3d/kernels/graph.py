"""Robust Gauss-Newton on a graph of relative poses, its normal equations kept within their envelope.

References
----------
.. [1] A. Jennings, "A compact storage scheme for the solution of symmetric linear simultaneous equations",
   Comput. J. 9, 1966.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray, IntArray

# Assigning whole rows would make numba compile the texts of NumPy's errors, for two seconds.
_FAST = {"reassoc", "contract", "arcp"}
_RIDGE = 1e-9
_SMALL_RAD = 1e-3
"""Angle below which the series of SE(3)'s logarithm is used, as SciPy does."""


class PoseGraph(NamedTuple):
    """Edges, and the rows of the normal equations of all frames but the first, which is the identity.

    Attributes
    ----------
    first, second : int64, shape (e,)
        Frames of each edge, two different ones.
    expected : float64, shape (e, 4, 4)
        First frame's pose in the second, as measured.
    information : float64, shape (e, 6, 6)
        Inverse covariance of (rotation, translation).
    begin : int64, shape (6 (n - 1),)
        First column of each row that is kept; the last is the diagonal.
    at : int64, shape (6 (n - 1),)
        Where column 0 of each row would be in `rows`.
    rows : float64
        Room for all that is kept.
    """

    first: IntArray
    second: IntArray
    expected: FloatArray
    information: FloatArray
    begin: IntArray
    at: IntArray
    rows: FloatArray


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def relax(graph: PoseGraph, poses: FloatArray, huber: float, rounds: int, settled: float) -> None:
    """Move poses to where the edges' errors, beyond `huber` deviations taken singly, are least.

    Parameters
    ----------
    graph : PoseGraph
    poses : float64, shape (n, 4, 4)
        The start, overwritten with the result; the first stays as it is.
    rounds : int
        At most so many.
    settled : float
        Largest step, mm and rad, after which no further one is made.
    """
    step = np.empty(graph.begin.size)
    for _ in range(rounds):
        _gather(graph, poses, huber, step)
        _factor(graph)
        _solve(graph, step)
        largest = 0.0
        for f in range(1, len(poses)):
            moved = step[6 * f - 6 : 6 * f]
            for k in range(6):
                moved[k] = -moved[k]
                largest = max(largest, abs(moved[k]))
            _move(poses[f], moved)
        if largest < settled:
            break


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def marginals(graph: PoseGraph, poses: FloatArray, huber: float, frames: IntArray, out: FloatArray) -> None:
    """Fill `out`, shape (k, 6, 6), with the covariance of (rotation, translation) of some frames' poses."""
    size = graph.begin.size
    _gather(graph, poses, huber, np.empty(size))
    _factor(graph)
    rows, x = graph.rows, np.empty((6, size))
    for k in range(frames.size):
        own = 6 * (frames[k] - 1)
        for c in range(6):
            for i in range(own, size):
                total = 1.0 if i == own + c else 0.0
                for j in range(max(graph.begin[i], own), i):
                    total -= rows[graph.at[i] + j] * x[c, j]
                x[c, i] = total / rows[graph.at[i] + i]
        for a in range(6):
            for b in range(6):
                total = 0.0
                for i in range(own, size):
                    total += x[a, i] * x[b, i]
                out[k, a, b] = total


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _gather(graph: PoseGraph, poses: FloatArray, huber: float, gradient: FloatArray) -> None:
    """Fill the rows with the normal equations at some poses; the increments of these are on the right."""
    rows, at = graph.rows, graph.at
    for i in range(rows.size):
        rows[i] = 0.0
    for i in range(at.size):
        gradient[i] = 0.0
        rows[at[i] + i] = _RIDGE
    relative, left = np.empty((4, 4)), np.empty((4, 4))
    error, pull, carried = np.empty(6), np.empty(6), np.empty((6, 6))
    weighed, twice = np.empty((6, 6)), np.empty((6, 6))
    for e in range(graph.first.size):
        first, second, omega = graph.first[e], graph.second[e], graph.information[e]
        _between(poses[first], poses[second], relative)
        _product(graph.expected[e], relative, left)
        _logarithm(left, error)
        size = 0.0
        for a in range(6):
            pull[a] = 0.0
            for b in range(6):
                pull[a] += omega[a, b] * error[b]
            size += pull[a] * error[a]
        weight = min(1.0, huber / max(np.sqrt(max(size, 0.0) / 6.0), 1e-9))
        _adjoint_of_inverse(relative, carried)
        for a in range(6):
            for b in range(6):
                weighed[a, b] = weight * omega[a, b]
        for a in range(6):
            for b in range(6):
                twice[a, b] = 0.0
                for c in range(6):
                    twice[a, b] -= weighed[a, c] * carried[c, b]
        i, j = 6 * (first - 1), 6 * (second - 1)
        if second > 0:
            for a in range(6):
                gradient[j + a] += weight * pull[a]
                for b in range(a + 1):
                    rows[at[j + a] + j + b] += weighed[a, b]
        if first > 0:
            for a in range(6):
                for c in range(6):
                    gradient[i + a] -= carried[c, a] * weight * pull[c]
                for b in range(a + 1):
                    for c in range(6):
                        rows[at[i + a] + i + b] -= carried[c, a] * twice[c, b]
        if first > 0 and second > 0:
            for a in range(6):
                for b in range(6):
                    if second > first:
                        rows[at[j + a] + i + b] += twice[a, b]
                    else:
                        rows[at[i + a] + j + b] += twice[b, a]


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _factor(graph: PoseGraph) -> None:
    """Cholesky factor in place of the rows."""
    rows, at, begin = graph.rows, graph.at, graph.begin
    for i in range(begin.size):
        own = rows[at[i] + begin[i] : at[i] + i + 1]
        for j in range(begin[i], i):
            start = max(begin[i], begin[j])
            other = rows[at[j] + start : at[j] + j]
            total = 0.0
            for k in range(other.size):
                total += own[start - begin[i] + k] * other[k]
            own[j - begin[i]] = (own[j - begin[i]] - total) / rows[at[j] + j]
        total = 0.0
        for k in range(i - begin[i]):
            total += own[k] * own[k]
        own[i - begin[i]] = np.sqrt(own[i - begin[i]] - total)


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _solve(graph: PoseGraph, x: FloatArray) -> None:
    """Solve with the factor, forwards and back, in place."""
    rows, at, begin = graph.rows, graph.at, graph.begin
    for i in range(x.size):
        total = x[i]
        for j in range(begin[i], i):
            total -= rows[at[i] + j] * x[j]
        x[i] = total / rows[at[i] + i]
    for i in range(x.size - 1, -1, -1):
        x[i] /= rows[at[i] + i]
        for j in range(begin[i], i):
            x[j] -= rows[at[i] + j] * x[i]


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _between(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Pose of the second in the first."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[0, i] * b[0, j] + a[1, i] * b[1, j] + a[2, i] * b[2, j]
        out[i, 3] = 0.0
        for k in range(3):
            out[i, 3] += a[k, i] * (b[k, 3] - a[k, 3])
    for j in range(4):
        out[3, j] = a[3, j]


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _product(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    for i in range(3):
        for j in range(4):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
        out[i, 3] += a[i, 3]
    for j in range(4):
        out[3, j] = b[3, j]


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _logarithm(pose: FloatArray, out: FloatArray) -> None:
    """Exponential coordinates of a pose, rotation first."""
    # The largest component of the quaternion is found first: the angle may be near a half turn.
    trace = pose[0, 0] + pose[1, 1] + pose[2, 2]
    largest, most = 3, trace
    for i in range(3):
        if pose[i, i] > most:
            largest, most = i, pose[i, i]
    x, y, z = pose[2, 1] - pose[1, 2], pose[0, 2] - pose[2, 0], pose[1, 0] - pose[0, 1]
    w = 1.0 + trace
    if largest == 0:
        w, y, z = x, pose[0, 1] + pose[1, 0], pose[0, 2] + pose[2, 0]
        x = 1.0 - trace + 2.0 * pose[0, 0]
    elif largest == 1:
        w, x, z = y, pose[0, 1] + pose[1, 0], pose[1, 2] + pose[2, 1]
        y = 1.0 - trace + 2.0 * pose[1, 1]
    elif largest == 2:
        w, x, y = z, pose[0, 2] + pose[2, 0], pose[1, 2] + pose[2, 1]
        z = 1.0 - trace + 2.0 * pose[2, 2]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    norm = np.sqrt(x * x + y * y + z * z)
    angle = 2.0 * np.arctan2(norm, w)
    scale = angle / norm if norm > 1e-12 * w else 2.0 / w
    x, y, z = scale * x, scale * y, scale * z
    if angle < _SMALL_RAD:
        k = 1.0 / 12.0 + angle**2 / 720.0 + angle**4 / 30240.0
    else:
        k = (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2
    # (1 - w x / 2 + k w x w x) t, with w x (w x t) = w (w . t) - t w^2
    u, v, s = pose[0, 3], pose[1, 3], pose[2, 3]
    along, square = x * u + y * v + z * s, x * x + y * y + z * z
    out[0], out[1], out[2] = x, y, z
    out[3] = u - 0.5 * (y * s - z * v) + k * (x * along - u * square)
    out[4] = v - 0.5 * (z * u - x * s) + k * (y * along - v * square)
    out[5] = s - 0.5 * (x * v - y * u) + k * (z * along - s * square)


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _move(pose: FloatArray, twist: FloatArray) -> None:
    """Multiply a pose from the right by the exponential of a twist, rotation first."""
    x, y, z, u, v, s = twist[0], twist[1], twist[2], twist[3], twist[4], twist[5]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    if angle < _SMALL_RAD:
        a = 1.0 - square / 6.0 + square**2 / 120.0
        b = 0.5 - square / 24.0 + square**2 / 720.0
        c = 1.0 / 6.0 - square / 120.0 + square**2 / 5040.0
    else:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
        c = (1.0 - a) / square
    along = x * u + y * v + z * s
    shift = (
        u + b * (y * s - z * v) + c * (x * along - u * square),
        v + b * (z * u - x * s) + c * (y * along - v * square),
        s + b * (x * v - y * u) + c * (z * along - s * square),
    )
    for i in range(3):
        p, q, r = pose[i, 0], pose[i, 1], pose[i, 2]
        pose[i, 3] += p * shift[0] + q * shift[1] + r * shift[2]
        # R (1 + a w x + b (w w' - w^2))
        dot = b * (p * x + q * y + r * z)
        pose[i, 0] += a * (q * z - r * y) + dot * x - b * square * p
        pose[i, 1] += a * (r * x - p * z) + dot * y - b * square * q
        pose[i, 2] += a * (p * y - q * x) + dot * z - b * square * r


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _adjoint_of_inverse(pose: FloatArray, out: FloatArray) -> None:
    """Matrix that carries (rotation, translation) twists through a pose's inverse."""
    for i in range(3):
        for j in range(3):
            out[i, j] = out[3 + i, 3 + j] = pose[j, i]
            out[i, 3 + j] = 0.0
        # [-R' t]x R' = -R' [t]x
        x, y, z = pose[0, i], pose[1, i], pose[2, i]
        u, v, s = pose[0, 3], pose[1, 3], pose[2, 3]
        out[3 + i, 0] = z * v - y * s
        out[3 + i, 1] = x * s - z * u
        out[3 + i, 2] = y * u - x * v
