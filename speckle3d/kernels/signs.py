"""Following the likeliest paths of position and slope through frames whose pairs have no sign."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.kernels.copying import copy_into


class PathRules(NamedTuple):
    """Rules for following paths; see `speckle3d.motion.signs`."""

    hypotheses: int
    relative_error: float
    cap: float
    turning_cost: float
    trend_mm: float
    same_mm: float
    apart_mm: float
    width_mm: float


@register_jitable(fastmath=False, error_model="numpy")
def _agree(
    place: FloatArray, reference: FloatArray, move: FloatArray, weight: FloatArray
) -> tuple[float, float]:
    """Squared deviation of a frame's place against another from an unsigned plane, and the likelier sign."""
    z, slope = place[0] - reference[0], place[1] - reference[1]
    u, v = z - move[0], slope - move[1]
    plus = weight[0] * u * u + 2.0 * weight[1] * u * v + weight[2] * v * v
    u, v = z + move[0], slope + move[1]
    minus = weight[0] * u * u + 2.0 * weight[1] * u * v + weight[2] * v * v
    return (plus, 1.0) if plus <= minus else (minus, -1.0)


@register_jitable(fastmath=False, error_model="numpy")
def _invert(covariance: FloatArray, move: FloatArray, rules: PathRules, weight: FloatArray) -> None:
    """Fill the three numbers of a pair's inverse covariance."""
    # The earlier frame was placed by such pairs, too.
    a = 2.0 * covariance[0, 0] + (rules.relative_error * move[0]) ** 2
    b = 2.0 * covariance[0, 1]
    c = 2.0 * covariance[1, 1] + (rules.relative_error * move[1]) ** 2
    determinant = a * c - b * b
    weight[0], weight[1], weight[2] = c / determinant, -b / determinant, a / determinant


@register_jitable(fastmath=False, error_model="numpy")
def _refine(
    place: FloatArray, path: FloatArray, earlier: IntArray, moves: FloatArray, weight: FloatArray, cap: float
) -> None:
    """Move a place to the weighted mean of where the pairs that agree with it put the frame."""
    w00 = w01 = w11 = u0 = u1 = 0.0
    for e in range(len(moves)):
        reference = path[earlier[e]]
        misfit, sign = _agree(place, reference, moves[e], weight[e])
        if misfit < cap:
            z, slope = reference[0] + sign * moves[e, 0], reference[1] + sign * moves[e, 1]
            w00 += weight[e, 0]
            w01 += weight[e, 1]
            w11 += weight[e, 2]
            u0 += weight[e, 0] * z + weight[e, 1] * slope
            u1 += weight[e, 1] * z + weight[e, 2] * slope
    if w00 > 0.0:
        determinant = w00 * w11 - w01 * w01
        place[0] = (w11 * u0 - w01 * u1) / determinant
        place[1] = (w00 * u1 - w01 * u0) / determinant


@register_jitable(fastmath=False, error_model="numpy")
def _next_trend(trend: float, step: float, trend_mm: float) -> float:
    """Direction of a path after a step: averaged over travel and not time, so that a pause keeps it."""
    return float(trend + (1.0 - np.exp(-abs(step) / trend_mm)) * (np.sign(step) - trend))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def follow_paths(
    start: IntArray,
    first: IntArray,
    moves: FloatArray,
    covariance: FloatArray,
    unlike_start: IntArray,
    unlike: IntArray,
    rules: PathRules,
    best: FloatArray,
    placed_frames: int = 1,
) -> None:
    """Place frame after frame by its pairs with earlier ones, on the likeliest paths.

    Parameters
    ----------
    start : int64, shape (n + 1,)
        Pairs of frame f are ``start[f]`` to ``start[f + 1]``.
    first : int64, shape (e,)
        Earlier frame of each pair.
    moves : float64, shape (e, 2)
        Unsigned offset and slope, whose signs belong together.
    covariance : float64, shape (e, 2, 2)
    unlike_start, unlike : int64, shape (n + 1,) and (u,)
        Likewise, earlier frames that a frame does not resemble.
    rules : PathRules
    best : float64, shape (n, 2)
        Receives position and slope of every frame on the path of least cost. Frames that no pair places stay
        where the one before them is.
    placed_frames : int
        So many frames at the beginning are in `best` already, and stay.
    """
    count, frames = rules.hypotheses, start.size - 1
    paths, spare = np.zeros((count, frames, 2)), np.zeros((count, frames, 2))
    cost, trend, places = np.zeros(count), np.ones(count), np.zeros((count, 2))
    parent, new_cost, new_trend = np.zeros(count, np.int64), np.zeros(count), np.zeros(count)
    for f in range(placed_frames):
        paths[0, f, 0], paths[0, f, 1] = best[f, 0], best[f, 1]
        if f > 0:
            trend[0] = _next_trend(trend[0], best[f, 0] - best[f - 1, 0], rules.trend_mm)
    survivors, moving = 1, False
    for f in range(placed_frames, frames):
        pairs = start[f + 1] - start[f]
        if pairs == 0:
            for h in range(survivors):
                paths[h, f, 0], paths[h, f, 1] = paths[h, f - 1, 0], paths[h, f - 1, 1]
            continue
        earlier, steps = first[start[f] : start[f + 1]], moves[start[f] : start[f + 1]]
        weight, latest = np.empty((pairs, 3)), 0
        for e in range(pairs):
            _invert(covariance[start[f] + e], steps[e], rules, weight[e])
            latest = e if earlier[e] > earlier[latest] else latest
        for h in range(survivors):
            moving = moving or paths[h, f - 1, 0] != 0.0 or paths[h, f - 1, 1] != 0.0
        candidates, total = np.empty((2 * pairs * survivors, 2)), np.empty(2 * pairs * survivors)
        for n in range(total.size):
            h, e, side = n // (2 * pairs), n % pairs, 1.0 if n // pairs % 2 == 0 else -1.0
            for k in range(2):
                candidates[n, k] = paths[h, earlier[e], k] + side * steps[e, k]
            total[n] = cost[h]
            for i in range(pairs):
                total[n] += min(
                    _agree(candidates[n], paths[h, earlier[i]], steps[i], weight[i])[0], rules.cap
                )
            if (candidates[n, 0] - paths[h, earlier[latest], 0]) * trend[h] < 0.0:
                total[n] += rules.turning_cost
            for stranger in unlike[unlike_start[f] : unlike_start[f + 1]]:
                off = candidates[n, 0] - paths[h, stranger, 0]
                turned = rules.width_mm * (candidates[n, 1] - paths[h, stranger, 1])
                if off**2 + turned**2 < rules.apart_mm**2:
                    total[n] += rules.cap
            if not moving and candidates[n, 0] < 0.0:
                # The overall sign is open: of two mirror images one is enough.
                total[n] = np.inf
        size = 0
        for _ in range(min(4 * count, total.size)):
            n = int(np.argmin(total))
            if size == count or not np.isfinite(total[n]):
                break
            h, place = n // (2 * pairs), candidates[n]
            _refine(place, paths[h], earlier, steps, weight, rules.cap)
            is_duplicate = False
            for g in range(size):
                off = abs(places[g, 0] - place[0])
                for e in range(pairs):
                    off = max(off, abs(paths[parent[g], earlier[e], 0] - paths[h, earlier[e], 0]))
                is_duplicate = is_duplicate or off < rules.same_mm
            if not is_duplicate:
                places[size, 0], places[size, 1] = place[0], place[1]
                parent[size], new_cost[size] = h, total[n]
                step = place[0] - paths[h, earlier[latest], 0]
                new_trend[size] = _next_trend(trend[h], step, rules.trend_mm)
                size += 1
            total[n] = np.inf
        if size:
            for g in range(size):
                for n in range(f):
                    spare[g, n, 0], spare[g, n, 1] = paths[parent[g], n, 0], paths[parent[g], n, 1]
                spare[g, f, 0], spare[g, f, 1] = places[g, 0], places[g, 1]
                # The first is the likeliest.
                trend[g], cost[g] = new_trend[g], new_cost[g] - new_cost[0]
            paths, spare, survivors = spare, paths, size
    copy_into(best, paths[0])
