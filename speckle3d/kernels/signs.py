"""Following the likeliest paths of position and slope through frames whose pairs have no sign."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray, IntArray


class PathRules(NamedTuple):
    """How paths are followed; see `speckle3d.motion.signs`."""

    hypotheses: int
    relative_error: float
    placed: float
    cap: float
    turning_cost: float
    trend_mm: float
    same_mm: float
    same_slope: float
    apart_mm: float
    apart_slope: float
    apart_cost: float
    open_frames: int
    hold: bool


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _agree(z: float, slope: float, moved: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Squared deviation of a signed plane from an unsigned one, and the sign that makes it least."""
    u, v = z - moved[0], slope - moved[1]
    plus = weight[0] * u * u + 2.0 * weight[1] * u * v + weight[2] * v * v
    u, v = z + moved[0], slope + moved[1]
    minus = weight[0] * u * u + 2.0 * weight[1] * u * v + weight[2] * v * v
    return (plus, 1.0) if plus <= minus else (minus, -1.0)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _invert(covariance: FloatArray, moved: FloatArray, rules: PathRules, weight: FloatArray) -> None:
    """Fill the three numbers of a pair's inverse covariance."""
    a = rules.placed * covariance[0, 0] + (rules.relative_error * moved[0]) ** 2
    b = rules.placed * covariance[0, 1]
    c = rules.placed * covariance[1, 1] + (rules.relative_error * moved[1]) ** 2
    determinant = a * c - b * b
    weight[0], weight[1], weight[2] = c / determinant, -b / determinant, a / determinant


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _refine(
    place: FloatArray,
    path: FloatArray,
    first: IntArray,
    moved: FloatArray,
    weight: FloatArray,
    cap: float,
) -> None:
    """Move a place to the weighted mean of where the pairs that agree with it put the frame."""
    w00 = w01 = w11 = u0 = u1 = 0.0
    near = False
    for e in range(first.size):
        z, slope = path[first[e], 0], path[first[e], 1]
        misfit, sign = _agree(place[0] - z, place[1] - slope, moved[e], weight[e])
        if misfit < cap:
            near = True
            told0, told1 = z + sign * moved[e, 0], slope + sign * moved[e, 1]
            w00 += weight[e, 0]
            w01 += weight[e, 1]
            w11 += weight[e, 2]
            u0 += weight[e, 0] * told0 + weight[e, 1] * told1
            u1 += weight[e, 1] * told0 + weight[e, 2] * told1
    if near:
        determinant = w00 * w11 - w01 * w01
        place[0] = (w11 * u0 - w01 * u1) / determinant
        place[1] = (w00 * u1 - w01 * u0) / determinant


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _least(values: FloatArray, size: int) -> int:
    """Where the least of the first values is, the first of equal ones."""
    at = 0
    for n in range(1, size):
        if values[n] < values[at]:
            at = n
    return at


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def follow_paths(
    start: IntArray,
    first: IntArray,
    moved: FloatArray,
    covariance: FloatArray,
    unlike_start: IntArray,
    unlike: IntArray,
    rules: PathRules,
    best: FloatArray,
    known: int = 1,
    known_trend: float = 1.0,
) -> None:
    """Place frame after frame by its pairs with earlier ones, on the likeliest paths.

    Parameters
    ----------
    start : int64, shape (n + 1,)
        Pairs of frame f are ``start[f]`` to ``start[f + 1]``.
    first : int64, shape (e,)
        Earlier frame of each pair.
    moved : float64, shape (e, 2)
        Unsigned offset and slope, whose signs belong together.
    covariance : float64, shape (e, 2, 2)
    unlike_start, unlike : int64, shape (n + 1,) and (u,)
        Likewise, earlier frames that a frame does not resemble.
    rules : PathRules
    best : float64, shape (n, 2)
        Receives position and slope of every frame on the path of least cost.
    known : int
        So many frames at the beginning are in `best` already, and stay.
    known_trend : float
        Direction in which these went at last, from -1 to +1. The sign of the first frame on its own is open.
    """
    frames = start.size - 1
    most = 1
    for f in range(frames):
        most = max(most, start[f + 1] - start[f])
    count = rules.hypotheses
    paths, others = np.zeros((count, frames, 2)), np.zeros((count, frames, 2))
    cost, new_cost = np.zeros(count), np.zeros(count)
    trend, new_trend = np.ones(count), np.ones(count)
    left, new_left = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    parents = np.zeros(count, np.int64)
    total = np.empty(count * 2 * most)
    candidates = np.empty((count * 2 * most, 2))
    weight, place = np.empty((most, 3)), np.empty(2)
    kept, settled = 1, 0
    if known > 1:
        trend[0], left[0] = known_trend, True
        for f in range(known):
            for k in range(2):
                paths[0, f, k] = best[f, k]
    for f in range(known, frames):
        low, pairs = start[f], start[f + 1] - start[f]
        if pairs == 0:
            if rules.hold:
                for h in range(kept):
                    for k in range(2):
                        paths[h, f, k] = paths[h, f - 1, k]
            continue
        here, moves = first[low : low + pairs], moved[low : low + pairs]
        latest = 0
        for e in range(pairs):
            _invert(covariance[low + e], moves[e], rules, weight[e])
            if here[e] > here[latest]:
                latest = e
        moving = False
        for h in range(kept):
            moving = moving or left[h]
        for h in range(kept):
            for k in range(2 * pairs):
                e, side = (k, 1.0) if k < pairs else (k - pairs, -1.0)
                n = 2 * pairs * h + k
                z = paths[h, here[e], 0] + side * moves[e, 0]
                slope = paths[h, here[e], 1] + side * moves[e, 1]
                candidates[n, 0], candidates[n, 1] = z, slope
                if not moving and z < 0.0:
                    # The overall sign is open: of two mirror images one is enough.
                    total[n] = np.inf
                    continue
                doubt = 0.0
                for i in range(pairs):
                    misfit, _ = _agree(
                        z - paths[h, here[i], 0], slope - paths[h, here[i], 1], moves[i], weight[i]
                    )
                    doubt += min(misfit, rules.cap)
                if (z - paths[h, here[latest], 0]) * trend[h] < 0.0:
                    doubt += rules.turning_cost
                for u in range(unlike_start[f], unlike_start[f + 1]):
                    if (
                        abs(z - paths[h, unlike[u], 0]) < rules.apart_mm
                        and abs(slope - paths[h, unlike[u], 1]) < rules.apart_slope
                    ):
                        doubt += rules.apart_cost
                total[n] = cost[h] + doubt
        size, found = 2 * pairs * kept, 0
        for _ in range(min(4 * count, size)):
            n = _least(total, size)
            if not np.isfinite(total[n]) or found == count:
                break
            parent = n // (2 * pairs)
            place[0], place[1] = candidates[n, 0], candidates[n, 1]
            _refine(place, paths[parent], here, moves, weight, rules.cap)
            same = False
            for h in range(found):
                off, turned = abs(others[h, f, 0] - place[0]), abs(others[h, f, 1] - place[1])
                for e in range(pairs):
                    off = max(off, abs(paths[parents[h], here[e], 0] - paths[parent, here[e], 0]))
                    turned = max(turned, abs(paths[parents[h], here[e], 1] - paths[parent, here[e], 1]))
                same = same or (off < rules.same_mm and turned < rules.same_slope)
            if not same:
                others[found, f, 0], others[found, f, 1] = place[0], place[1]
                parents[found], new_cost[found] = parent, total[n]
                # Averaged over travel and not over time, so that a pause, whose steps have random signs,
                # keeps it.
                step = place[0] - paths[parent, here[latest], 0]
                share = 1.0 - np.exp(-abs(step) / rules.trend_mm)
                new_trend[found] = trend[parent] + share * (np.sign(step) - trend[parent])
                new_left[found] = left[parent] or place[0] != 0.0 or place[1] != 0.0
                found += 1
            total[n] = np.inf
        if found == 0:
            continue
        # Of frames long past the best path so far stands.
        leader = _least(cost, kept)
        opened = max(settled, f - rules.open_frames)
        for g in range(settled, opened):
            for h in range(count):
                if h != leader:
                    for k in range(2):
                        paths[h, g, k] = paths[leader, g, k]
        settled = opened
        lowest = new_cost[_least(new_cost, found)]
        for h in range(found):
            for g in range(settled, f):
                for k in range(2):
                    others[h, g, k] = paths[parents[h], g, k]
            cost[h], trend[h], left[h] = new_cost[h] - lowest, new_trend[h], new_left[h]
        for h in range(found):
            for g in range(settled, f + 1):
                for k in range(2):
                    paths[h, g, k] = others[h, g, k]
        kept = found
    leader = _least(cost, kept)
    for f in range(frames):
        for k in range(2):
            best[f, k] = paths[leader, f, k]
