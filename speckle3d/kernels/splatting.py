"""Splat samples of frames into the voxels in which they lie, or the eight around them.

Positions are whole numbers of 2^-40 voxel, so that stepping along a line adds no error and a part of the
voxels gets exactly what it gets as part of all. Lines are cut to the voxels wanted before they are walked.
"""

import numpy as np
import numpy.typing as npt
from numba import njit
from numba.extending import register_jitable

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray
from speckle3d.kernels.samples import POSITION_BITS, SHARE_BITS, Samples

_WHOLE = 1 << POSITION_BITS
_SHIFT = POSITION_BITS - SHARE_BITS
_SHARE = 1.0 / (1 << SHARE_BITS)
_SHARES = (1 << SHARE_BITS) - 1
_LEAST_SHARE = 0.125
"""Of a sample, for the maximum and the latest: its share if it lies in the middle of eight voxels."""

Tags = npt.NDArray[np.uint32]


@register_jitable(fastmath=False, error_model="numpy")
def _cut(start: int, stop: int, at: int, step: int, low: int, high: int) -> tuple[int, int]:
    """Samples of a range whose position ``at + sample * step`` is at least `low` and below `high`."""
    first, last = at + start * step, at + (stop - 1) * step
    if min(first, last) >= low and max(first, last) < high:
        return start, stop
    if max(first, last) < low or min(first, last) >= high:
        return start, start
    if step < 0:
        # Seen from the other side, where the last position inside is the first.
        at, step, low, high = -at, -step, 1 - high, 1 - low
    return max(start, -((at - low) // step)), min(stop, -((at - high) // step))


@register_jitable(fastmath=False, error_model="numpy")
def cut_to_box(span: IntArray, m: IntArray, box: IntArray, reach: int) -> tuple[int, int, int, int, int, int]:
    """Part of a span of samples inside a box: its line, first and end, and where its first lies."""
    line, start, stop = span[0], span[1], span[2]
    x, y, z = m[0, 0] * line + m[0, 2], m[1, 0] * line + m[1, 2], m[2, 0] * line + m[2, 2]
    start, stop = _cut(start, stop, x, m[0, 1], (box[0, 0] - reach) * _WHOLE, box[0, 1] * _WHOLE)
    if start < stop:
        start, stop = _cut(start, stop, y, m[1, 1], (box[1, 0] - reach) * _WHOLE, box[1, 1] * _WHOLE)
    if start < stop:
        start, stop = _cut(start, stop, z, m[2, 1], (box[2, 0] - reach) * _WHOLE, box[2, 1] * _WHOLE)
    return line, start, stop, x + start * m[0, 1], y + start * m[1, 1], z + start * m[2, 1]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def add_nearest(samples: Samples, box: IntArray, table: FloatArray, tags: Tags) -> None:
    """Add weighted levels of several images to the voxels that their samples lie in.

    Parameters
    ----------
    samples : Samples
    box : ndarray, shape (3, 2)
        First voxel and end along i, j and k; others are left alone.
    table : ndarray, shape (n_k, n_j, n_i, 2), changed in place
        Sum of weighted levels, and of weights.
    tags : ndarray, shape (n_k, n_j, n_i), changed in place
        Tag of the image that a voxel's sum is of; not read without tags.
    """
    images, weights, maps, spans, first_tag, _ = samples
    n_j, n_i = table.shape[1:3]
    sums, marks = table.reshape(-1, 2), tags.reshape(-1)
    length = images.shape[2] + 1
    place, ends = np.empty(length, np.int64), np.empty(length, np.int64)
    so_far, counts = np.empty(length), np.empty(length)
    for n in range(images.shape[0]):
        m = maps[n]
        tag = first_tag + n if first_tag > 0 else 0
        weight = weights[n]
        dx, dy, dz = m[0, 1], m[1, 1], m[2, 1]
        for span in range(spans.shape[0]):
            line, start, stop, x, y, z = cut_to_box(spans[span], m, box, 0)
            count = stop - start
            if count <= 0:
                continue
            for s in range(count):
                k, j, i = z + s * dz, y + s * dy, x + s * dx
                place[s] = ((k >> POSITION_BITS) * n_j + (j >> POSITION_BITS)) * n_i + (i >> POSITION_BITS)
            place[count] = -1
            # Several samples in a row lie in one voxel. What they add is the difference of sums along the
            # line up to the last of them: processors cannot foresee where a branch would end a row.
            total, number, rows = 0.0, 0.0, 0
            for s in range(count):
                level = np.float64(images[n, line, start + s])
                if np.isfinite(level):
                    total += level
                    number += 1.0
                ends[rows], so_far[rows], counts[rows] = place[s], total, number
                rows += place[s] != place[s + 1]
            total = number = 0.0
            for row in range(rows):
                at = np.uint64(ends[row])
                if tag > 0 and counts[row] > number and marks[at] != tag:
                    marks[at] = tag
                    sums[at, 0], sums[at, 1] = 0.0, 0.0
                sums[at, 0] += weight * (so_far[row] - total)
                sums[at, 1] += weight * (counts[row] - number)
                total, number = so_far[row], counts[row]


@register_jitable(fastmath=False, error_model="numpy")
def _same_cell(x: int, y: int, z: int, i: int, j: int, k: int) -> bool:
    """Whether a position is in a voxel, or between the same eight."""
    return (((x >> POSITION_BITS) ^ i) | ((y >> POSITION_BITS) ^ j) | ((z >> POSITION_BITS) ^ k)) == 0


@register_jitable(fastmath=False, error_model="numpy")
def _fraction(x: int) -> float:
    """How far a position is from the voxel below to the one above."""
    return (x >> _SHIFT & _SHARES) * _SHARE


@register_jitable(fastmath=False, error_model="numpy")
def _large(share: float) -> float:
    """Drop a share that is too small to count."""
    return share if share >= _LEAST_SHARE else 0.0


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def add_linear(samples: Samples, box: IntArray, table: FloatArray, tags: Tags) -> None:
    """Share weighted levels of several images out to the eight voxel centres around each sample.

    Parameters
    ----------
    samples, box, table, tags
        As for `add_nearest`; with tags, shares below 1/8 do not count.
    """
    images, weights, maps, spans, first_tag, _ = samples
    n_j, n_i = table.shape[1:3]
    sums, marks = table.reshape(-1, 2), tags.reshape(-1)
    low_i, low_j, low_k = box[0, 0], box[1, 0], box[2, 0]
    last_i, last_j, last_k = box[0, 1] - 1, box[1, 1] - 1, box[2, 1] - 1
    for n in range(images.shape[0]):
        m = maps[n]
        tag = first_tag + n if first_tag > 0 else 0
        weight = weights[n]
        dx, dy, dz = m[0, 1], m[1, 1], m[2, 1]
        for span in range(spans.shape[0]):
            line, sample, stop, x, y, z = cut_to_box(spans[span], m, box, 1)
            while sample < stop:
                i, j, k = x >> POSITION_BITS, y >> POSITION_BITS, z >> POSITION_BITS
                # Sums of samples in a row between the same eight voxels, x fastest, in registers: arrays or
                # tuples take several times as long.
                t0 = t1 = t2 = t3 = t4 = t5 = t6 = t7 = 0.0
                w0 = w1 = w2 = w3 = w4 = w5 = w6 = w7 = 0.0
                inside = True
                while inside:
                    level = np.float64(images[n, line, sample])
                    if level == level:
                        fx, fy, fz = _fraction(x), _fraction(y), _fraction(z)
                        gx, gy, gz = 1.0 - fx, 1.0 - fy, 1.0 - fz
                        a, b, c, d = gy * gz, fy * gz, gy * fz, fy * fz
                        s0, s1, s2, s3 = gx * a, fx * a, gx * b, fx * b
                        s4, s5, s6, s7 = gx * c, fx * c, gx * d, fx * d
                        if tag > 0:
                            s0, s1, s2, s3 = _large(s0), _large(s1), _large(s2), _large(s3)
                            s4, s5, s6, s7 = _large(s4), _large(s5), _large(s6), _large(s7)
                        w0, w1, w2, w3 = w0 + s0, w1 + s1, w2 + s2, w3 + s3
                        w4, w5, w6, w7 = w4 + s4, w5 + s5, w6 + s6, w7 + s7
                        t0, t1, t2, t3 = t0 + level * s0, t1 + level * s1, t2 + level * s2, t3 + level * s3
                        t4, t5, t6, t7 = t4 + level * s4, t5 + level * s5, t6 + level * s6, t7 + level * s7
                    x, y, z, sample = x + dx, y + dy, z + dz, sample + 1
                    inside = sample < stop and _same_cell(x, y, z, i, j, k)
                totals, shares = (t0, t1, t2, t3, t4, t5, t6, t7), (w0, w1, w2, w3, w4, w5, w6, w7)
                for corner in range(8):
                    u, v, w = i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2)
                    if (
                        shares[corner] > 0.0
                        and low_i <= u <= last_i
                        and low_j <= v <= last_j
                        and low_k <= w <= last_k
                    ):
                        at = np.uint64((w * n_j + v) * n_i + u)
                        if tag > 0 and marks[at] != tag:
                            marks[at] = tag
                            sums[at, 0], sums[at, 1] = 0.0, 0.0
                        sums[at, 0] += weight * totals[corner]
                        sums[at, 1] += weight * shares[corner]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def keep_largest(samples: Samples, box: IntArray, table: Float32Array) -> None:
    """Keep the largest level in each voxel; shared out, a sample counts where its share is at least 1/8.

    Parameters
    ----------
    samples, box
        As for `add_nearest`.
    table : ndarray, shape (n_k, n_j, n_i), changed in place
        NaN where no sample was.
    """
    images, _, maps, spans, _, linear = samples
    for n in range(images.shape[0]):
        m = maps[n]
        for span in range(spans.shape[0]):
            line, start, stop, x, y, z = cut_to_box(spans[span], m, box, int(linear))
            for sample in range(start, stop):
                level = np.float32(images[n, line, sample])
                i, j, k = x >> POSITION_BITS, y >> POSITION_BITS, z >> POSITION_BITS
                if not linear:
                    if level == level and not table[k, j, i] >= level:
                        table[k, j, i] = level
                else:
                    fx, fy, fz = _fraction(x), _fraction(y), _fraction(z)
                    for corner in range(8):
                        u, v, w = corner & 1, corner >> 1 & 1, corner >> 2
                        share = (fx if u else 1.0 - fx) * (fy if v else 1.0 - fy) * (fz if w else 1.0 - fz)
                        if (
                            share >= _LEAST_SHARE
                            and box[0, 0] <= i + u < box[0, 1]
                            and box[1, 0] <= j + v < box[1, 1]
                            and box[2, 0] <= k + w < box[2, 1]
                            and level == level
                            and not table[k + w, j + v, i + u] >= level
                        ):
                            table[k + w, j + v, i + u] = level
                x, y, z = x + m[0, 1], y + m[1, 1], z + m[2, 1]
