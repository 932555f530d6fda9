"""Many plain decimal numbers at once, such as ``-0.123456``, exactly as one by one.

Programs that export logs write all numbers of a column with the same few decimals. So their digits lie in the
same places before the next separator, and are summed by place. What is not so simple is left to others.
"""

from __future__ import annotations

import numpy as np

from speckle3d.core.arrays import ByteArray, FloatArray, IntArray

_LONGEST_CELL = 17
"""Of a sign, a point and 15 digits."""

_MOST_EXACT = 2.0**53
"""Below it, digits without their point are exact in a double, and their quotient by a power of ten is the
nearest double there is."""

_LINES = 8192
"""Taken up at a time: what is made of them stays in the cache."""

_ZERO, _NEWLINE = b"0\n"
_POINT_LESS_ZERO, _MINUS_LESS_ZERO, _NINE = (ord(".") - _ZERO) % 256, (ord("-") - _ZERO) % 256, 9


def read_decimals(body: bytes, separator: str, count: int) -> FloatArray | None:
    """Numbers of a table, shape (lines, count), NaN where blank.

    Parameters
    ----------
    body : bytes
        Lines of cells.
    separator : str
        One character.
    count : int
        Of cells in each line.

    Returns
    -------
    ndarray, shape (lines, count), or None
        None if a line has another length, or a cell is no plain decimal number.
    """
    padded = np.frombuffer(b"\n" * _LONGEST_CELL + body + b"\n", dtype=np.uint8)
    ends = np.flatnonzero((padded == ord(separator)) | (padded == _NEWLINE))[_LONGEST_CELL:]
    if ends.size % count:
        return None
    ends = ends.reshape(-1, count)
    at_end = padded[ends] == _NEWLINE
    if at_end[:, :-1].any() or not at_end[:, -1].all():
        return None
    starts = np.roll(ends.ravel(), 1) + 1
    starts[0] = _LONGEST_CELL
    sizes = ends - starts.reshape(-1, count)
    if sizes.max() > _LONGEST_CELL:
        return None
    return _all_columns(padded, ends, sizes)


def _all_columns(padded: ByteArray, ends: IntArray, sizes: IntArray) -> FloatArray | None:
    values = np.empty(ends.shape)
    for first in range(0, len(ends), _LINES):
        lines = slice(first, first + _LINES)
        for column in range(ends.shape[1]):
            found = _column(padded, ends[lines, column], sizes[lines, column])
            if found is None:
                return None
            values[lines, column] = found
    return values


def _column(padded: ByteArray, ends: IntArray, sizes: IntArray) -> FloatArray | None:
    """Numbers that end before `ends`; None if any is no plain decimal, or has its point elsewhere."""
    width = max(int(sizes.max()), 1)
    windows = np.lib.stride_tricks.sliding_window_view(padded, width)
    digits = np.ascontiguousarray(windows[ends - width].T) - np.uint8(_ZERO)  # others wrap round to over 9
    digits[np.arange(width)[:, None] < width - sizes] = 0
    first = (np.minimum(width - sizes, width - 1), np.arange(ends.size))
    minus = (digits[first] == _MINUS_LESS_ZERO) & (sizes > 1)
    digits[first] = np.where(minus, 0, digits[first])
    points = np.flatnonzero(digits[:, sizes.argmax()] == _POINT_LESS_ZERO)
    point = int(points[0]) if points.size else width
    if points.size:
        if (digits[point, sizes > 0] != _POINT_LESS_ZERO).any() or (sizes - minus == 1)[sizes > 0].any():
            return None
        digits[point] = 0
    if digits.max() > _NINE:
        return None
    whole = np.zeros(ends.size)
    for place in range(width):
        if place != point:
            whole *= 10.0
            whole += digits[place]
    if whole.max() >= _MOST_EXACT:
        return None
    values = whole / 10.0 ** max(width - 1 - point, 0)
    return np.where(sizes > 0, np.where(minus, -values, values), np.nan)
