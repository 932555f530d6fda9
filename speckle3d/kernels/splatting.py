"""Samples of frames given to the voxels that they lie in, or to the eight around them.

Positions are whole numbers of 2^-40 voxel, so that stepping along a line adds no error and a part of the
voxels gets exactly what it gets as part of all. Lines are cut to the voxels wanted before they are walked.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray

POSITION_BITS = 40
"""Bits of a position behind the point; 23 before it and a sign."""
SHARE_BITS = 10
"""Bits behind the point of a position between eight voxels."""
COUNT_BITS = 40
"""Where a voxel's number of samples begins in the word that also holds their sum."""

_ONE_SAMPLE = np.uint64(1 << COUNT_BITS)
_WHOLE = 1 << POSITION_BITS
_DROPPED = POSITION_BITS - SHARE_BITS
_SHARE = 1.0 / (1 << SHARE_BITS)
_SHARES = (1 << SHARE_BITS) - 1
_LEAST_SHARE = 0.125

Numbers = npt.NDArray[Any]
Words = npt.NDArray[np.uint64]
Tags = npt.NDArray[np.uint32]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _cut(start: int, stop: int, at: int, step: int, low: int, high: int) -> tuple[int, int]:
    """Samples of a range whose position ``at + sample * step`` is at least `low` and below `high`."""
    first, last = at + start * step, at + (stop - 1) * step
    if min(first, last) >= low and max(first, last) < high:
        return start, stop
    if step > 0:
        return max(start, -((at - low) // step)), min(stop, -((at - high) // step))
    if step < 0:
        return max(start, (at - high) // -step + 1), min(stop, (at - low) // -step + 1)
    return start, start


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _cut_to_box(
    span: IntArray, m: IntArray, box: IntArray, reach: int
) -> tuple[int, int, int, int, int, int]:
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
def count_nearest(
    images: Numbers, maps: IntArray, spans: IntArray, box: IntArray, offset: int, table: Words
) -> None:
    """Add whole levels of several images to the voxels that their samples lie in.

    Parameters
    ----------
    images : ndarray of integers, shape (n, line, sample)
    maps : ndarray, shape (n, 3, 3)
        From (line, sample, 1) to positions (i, j, k) in units of 2^-40 voxel; voxel n reaches from n to n + 1
        whole ones.
    spans : ndarray, shape (m, 3)
        Line, first sample and end of what is used of every image.
    box : ndarray, shape (3, 2)
        First voxel and end along i, j and k; others are left alone.
    offset : int
        Added to each level, so that none is below zero.
    table : ndarray, shape (n_k, n_j, n_i), changed in place
        Sum of levels in the lower 40 bits, number of samples above.
    """
    n_j, n_i = table.shape[1:]
    words = table.reshape(-1)
    for n in range(images.shape[0]):
        m = maps[n]
        dx, dy, dz = m[0, 1], m[1, 1], m[2, 1]
        for span in spans:
            line, start, stop, x, y, z = _cut_to_box(span, m, box, 0)
            if start >= stop:
                continue
            # Several samples in a row lie in one voxel: memory is touched when it changes.
            held = np.uint64(0)
            at = ((z >> POSITION_BITS) * n_j + (y >> POSITION_BITS)) * n_i + (x >> POSITION_BITS)
            for sample in range(start, stop):
                here = ((z >> POSITION_BITS) * n_j + (y >> POSITION_BITS)) * n_i + (x >> POSITION_BITS)
                if here != at:
                    words[at] += held
                    at, held = here, np.uint64(0)
                held += _ONE_SAMPLE + np.uint64(np.int64(images[n, line, sample]) + offset)
                x, y, z = x + dx, y + dy, z + dz
            words[at] += held


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _give(sums: FloatArray, tags: Tags, tag: int, at: int, total: float, weight: float) -> None:
    """Add to a voxel; with a tag, in place of what frames of other tags gave."""
    if weight > 0.0:
        if tag > 0 and tags[at] != tag:
            tags[at] = tag
            sums[at, 0], sums[at, 1] = total, weight
        else:
            sums[at, 0] += total
            sums[at, 1] += weight


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def add_nearest(
    images: Numbers,
    weights: Float32Array,
    maps: IntArray,
    spans: IntArray,
    box: IntArray,
    first_tag: int,
    table: FloatArray,
    tags: Tags,
) -> None:
    """Add weighted levels of several images to the voxels that their samples lie in.

    Parameters
    ----------
    images : ndarray, shape (n, line, sample)
        NaN does not count.
    weights : ndarray, shape (n, line, sample)
        Samples whose weight is not above zero do not count.
    maps, spans, box
        As for `count_nearest`.
    first_tag : int
        With 0 all images count; else the last that has a sample in a voxel: this is the first one's tag, and
        the others' follow.
    table : ndarray, shape (n_k, n_j, n_i, 2), changed in place
        Sum of weighted levels, and of weights.
    tags : ndarray, shape (n_k, n_j, n_i), changed in place
        Tag of the image that a voxel's sum is of; not read without tags.
    """
    n_j, n_i = table.shape[1:3]
    sums, marks = table.reshape(-1, 2), tags.reshape(-1)
    for n in range(images.shape[0]):
        m = maps[n]
        tag = first_tag + n if first_tag > 0 else 0
        dx, dy, dz = m[0, 1], m[1, 1], m[2, 1]
        for span in spans:
            line, start, stop, x, y, z = _cut_to_box(span, m, box, 0)
            if start >= stop:
                continue
            total, weight = 0.0, 0.0
            at = ((z >> POSITION_BITS) * n_j + (y >> POSITION_BITS)) * n_i + (x >> POSITION_BITS)
            for sample in range(start, stop):
                here = ((z >> POSITION_BITS) * n_j + (y >> POSITION_BITS)) * n_i + (x >> POSITION_BITS)
                if here != at:
                    _give(sums, marks, tag, at, total, weight)
                    at, total, weight = here, 0.0, 0.0
                level, share = float(images[n, line, sample]), float(weights[n, line, sample])
                if level == level and share > 0.0:
                    total += share * level
                    weight += share
                x, y, z = x + dx, y + dy, z + dz
            _give(sums, marks, tag, at, total, weight)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def raise_nearest(
    images: Numbers, maps: IntArray, spans: IntArray, box: IntArray, table: Float32Array
) -> None:
    """Raise voxels to the largest level of the samples that lie in them.

    Parameters
    ----------
    images, maps, spans, box
        As for `add_nearest`.
    table : ndarray, shape (n_k, n_j, n_i), changed in place
        NaN where no sample was.
    """
    n_j, n_i = table.shape[1:]
    levels = table.reshape(-1)
    for n in range(images.shape[0]):
        m = maps[n]
        for span in spans:
            line, start, stop, x, y, z = _cut_to_box(span, m, box, 0)
            for sample in range(start, stop):
                at = ((z >> POSITION_BITS) * n_j + (y >> POSITION_BITS)) * n_i + (x >> POSITION_BITS)
                level = np.float32(images[n, line, sample])
                if level == level and not levels[at] >= level:
                    levels[at] = level
                x, y, z = x + m[0, 1], y + m[1, 1], z + m[2, 1]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _share_out(
    table: FloatArray,
    tags: Tags,
    tag: int,
    box: IntArray,
    cell: tuple[int, int, int],
    totals: tuple[float, ...],
    weights: tuple[float, ...],
) -> None:
    """Give the eight voxels around a cell, where they are in the box, what its samples amount to."""
    n_j, n_i = table.shape[1:3]
    sums, marks = table.reshape(-1, 2), tags.reshape(-1)
    i, j, k = cell
    at = (k * n_j + j) * n_i + i
    plane = n_j * n_i
    if box[0, 0] <= i < box[0, 1] - 1 and box[1, 0] <= j < box[1, 1] - 1 and box[2, 0] <= k < box[2, 1] - 1:
        _give(sums, marks, tag, at, totals[0], weights[0])
        _give(sums, marks, tag, at + 1, totals[1], weights[1])
        _give(sums, marks, tag, at + n_i, totals[2], weights[2])
        _give(sums, marks, tag, at + n_i + 1, totals[3], weights[3])
        _give(sums, marks, tag, at + plane, totals[4], weights[4])
        _give(sums, marks, tag, at + plane + 1, totals[5], weights[5])
        _give(sums, marks, tag, at + plane + n_i, totals[6], weights[6])
        _give(sums, marks, tag, at + plane + n_i + 1, totals[7], weights[7])
        return
    for corner in range(8):
        a, b, c = i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2)
        if box[0, 0] <= a < box[0, 1] and box[1, 0] <= b < box[1, 1] and box[2, 0] <= c < box[2, 1]:
            _give(sums, marks, tag, (c * n_j + b) * n_i + a, totals[corner], weights[corner])


_NONE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def add_linear(
    images: Numbers,
    weights: Float32Array,
    maps: IntArray,
    spans: IntArray,
    box: IntArray,
    first_tag: int,
    table: FloatArray,
    tags: Tags,
) -> None:
    """Share weighted levels of several images out to the eight voxel centres around each sample.

    Parameters
    ----------
    images, weights, spans, box, table, tags
        As for `add_nearest`.
    maps : ndarray, shape (n, 3, 3)
        As for `add_nearest`, but the centre of voxel n is n, and positions are half of 2^-10 voxel ahead:
        shares are of positions rounded to 2^-10 voxel.
    first_tag : int
        As for `add_nearest`; with tags, shares below 1/8 do not count.
    """
    for n in range(images.shape[0]):
        m = maps[n]
        tag = first_tag + n if first_tag > 0 else 0
        least = _LEAST_SHARE if tag > 0 else 0.0
        dx, dy, dz = m[0, 1], m[1, 1], m[2, 1]
        for span in spans:
            line, start, stop, x, y, z = _cut_to_box(span, m, box, 1)
            if start >= stop:
                continue
            t, w = _NONE, _NONE
            i, j, k = x >> POSITION_BITS, y >> POSITION_BITS, z >> POSITION_BITS
            for sample in range(start, stop):
                a, b, c = x >> POSITION_BITS, y >> POSITION_BITS, z >> POSITION_BITS
                if ((a ^ i) | (b ^ j) | (c ^ k)) != 0:
                    _share_out(table, tags, tag, box, (i, j, k), t, w)
                    i, j, k = a, b, c
                    t, w = _NONE, _NONE
                level, share = float(images[n, line, sample]), float(weights[n, line, sample])
                if level == level and share > 0.0:
                    s = _shares(x, y, z, least, share)
                    w = (w[0] + s[0], w[1] + s[1], w[2] + s[2], w[3] + s[3],
                         w[4] + s[4], w[5] + s[5], w[6] + s[6], w[7] + s[7])  # fmt: skip
                    t = (t[0] + s[0] * level, t[1] + s[1] * level, t[2] + s[2] * level, t[3] + s[3] * level,
                         t[4] + s[4] * level, t[5] + s[5] * level, t[6] + s[6] * level,
                         t[7] + s[7] * level)  # fmt: skip
                x, y, z = x + dx, y + dy, z + dz
            _share_out(table, tags, tag, box, (i, j, k), t, w)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _shares(
    x: int, y: int, z: int, least: float, weight: float
) -> tuple[float, float, float, float, float, float, float, float]:
    """Shares of a sample that the eight voxels around it get, x fastest; those below `least` are none."""
    fx, fy, fz = (
        (x >> _DROPPED & _SHARES) * _SHARE,
        (y >> _DROPPED & _SHARES) * _SHARE,
        (z >> _DROPPED & _SHARES) * _SHARE,
    )
    gx, gy, gz = 1.0 - fx, 1.0 - fy, 1.0 - fz
    near, far = gz, fz
    a, b, c, d = gy * near, fy * near, gy * far, fy * far
    s = (gx * a, fx * a, gx * b, fx * b, gx * c, fx * c, gx * d, fx * d)
    if least > 0.0:
        s = (
            s[0] if s[0] >= least else 0.0,
            s[1] if s[1] >= least else 0.0,
            s[2] if s[2] >= least else 0.0,
            s[3] if s[3] >= least else 0.0,
            s[4] if s[4] >= least else 0.0,
            s[5] if s[5] >= least else 0.0,
            s[6] if s[6] >= least else 0.0,
            s[7] if s[7] >= least else 0.0,
        )
    return (
        s[0] * weight, s[1] * weight, s[2] * weight, s[3] * weight,
        s[4] * weight, s[5] * weight, s[6] * weight, s[7] * weight,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def raise_linear(
    images: Numbers, maps: IntArray, spans: IntArray, box: IntArray, table: Float32Array
) -> None:
    """Raise voxels to the largest level of the samples of which they get a share of at least 1/8.

    Parameters
    ----------
    images, maps, spans, box
        As for `add_linear`.
    table : ndarray, shape (n_k, n_j, n_i), changed in place
        NaN where no sample was.
    """
    for n in range(images.shape[0]):
        m = maps[n]
        for span in spans:
            line, start, stop, x, y, z = _cut_to_box(span, m, box, 1)
            for sample in range(start, stop):
                level = np.float32(images[n, line, sample])
                if level == level:
                    i, j, k = x >> POSITION_BITS, y >> POSITION_BITS, z >> POSITION_BITS
                    s = _shares(x, y, z, 0.0, 1.0)
                    for corner in range(8):
                        a, b, c = i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2)
                        if (
                            s[corner] >= _LEAST_SHARE
                            and box[0, 0] <= a < box[0, 1]
                            and box[1, 0] <= b < box[1, 1]
                            and box[2, 0] <= c < box[2, 1]
                            and not table[c, b, a] >= level
                        ):
                            table[c, b, a] = level
                x, y, z = x + m[0, 1], y + m[1, 1], z + m[2, 1]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def means_of_counts(table: Words, offset: int, voxels: Float32Array, state: npt.NDArray[np.uint8]) -> None:
    """Turn what `count_nearest` made into means and states.

    Parameters
    ----------
    table : ndarray, shape (n_k, n_j, n_i)
    offset : int
        What was added to each level.
    voxels : ndarray, shape (n_k, n_j, n_i), filled in
        NaN where no sample was.
    state : ndarray, shape (n_k, n_j, n_i), filled in
        1 where a sample was, else 0.
    """
    words, means, marks = table.reshape(-1), voxels.reshape(-1), state.reshape(-1)
    for at in range(words.size):
        count = np.int64(words[at] >> np.uint64(COUNT_BITS))
        total = np.int64(words[at] & np.uint64((1 << COUNT_BITS) - 1))
        means[at] = np.float32((total - count * offset) / count)
        marks[at] = count > 0


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def means_of_sums(table: FloatArray, voxels: Float32Array, state: npt.NDArray[np.uint8]) -> None:
    """Turn what `add_nearest` or `add_linear` made into means and states, as for `means_of_counts`."""
    sums, means, marks = table.reshape(-1, 2), voxels.reshape(-1), state.reshape(-1)
    for at in range(means.size):
        means[at] = np.float32(sums[at, 0] / sums[at, 1])
        marks[at] = sums[at, 1] > 0.0
