"""Automatic detection of the straight line that a plane's echo makes in an image.

Each column is searched downwards for the first strong edge from dark to light; the line is the one that most
of these edges agree with. A frame in which too few agree is dropped, with the reason.

References
----------
.. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, appendix B.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from calibration.detection.region import Columns, choose_columns, detect_in_frames
from calibration.points import Detections
from calibration.settings import LineSettings, Place
from speckle3d.core.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.progress import Progress
from speckle3d.core.sweep import Frames

_ROUNDS = 5
"""Fits of the line to the points that agree on it, which then hardly change."""
_FINE = 0.25
"""Smoothing for placing an echo, as a share of that for finding it: enough against noise, little against
the rise of an echo."""
_REACH = 3.5
"""Length of the filters' sides, standard deviations."""
_AHEAD = 2.0
"""Farthest that an echo is brightest below its edge, standard deviations; its length is 1.5 of them."""
_LEAST = 0.3
"""Least slope of an edge, as a share of the median of the columns' steepest slopes."""
_PARTS = (0.95, 0.85, 0.75, 0.65, 0.5)
"""Least brightness of an echo when no threshold is given, as shares of the median of the columns' brightest
echoes: each is tried."""
_WEAKER = 0.75
"""Least brightness, as a share of the brightest line's, of a line that is preferred for lying above it: haze
and side lobes are fainter. The floor's reverberations lie beneath it and are no brighter."""
_LEAST_SHARE = 0.25
"""Share of all sampled columns that must agree, however few the line could meet: with a line that cuts a
corner of the region, two or three noisy edges always agree."""


@dataclass(frozen=True)
class EchoLine:
    """The line of a plane's echo in one image.

    Attributes
    ----------
    inlier_px : ndarray, shape (k, 2)
        Column and row of the edges that agree.
    possible : int
        Sampled columns in which the line is inside the region.
    start, slope : float
        Row in column 0, and rows to a column.
    strength : float
        Mean of the edges that agree.
    """

    inlier_px: FloatArray
    possible: int
    start: float
    slope: float
    strength: float

    @property
    def consensus(self) -> int:
        """Number of columns that agree."""
        return len(self.inlier_px)

    @property
    def points_px(self) -> FloatArray:
        """Column and row of two points on the line, shape (2, 2).

        At the mean of the agreeing columns minus and plus their root mean square spread: there the errors of
        a fitted line are uncorrelated and equal.
        """
        column = self.inlier_px[:, 0]
        ends = column.mean() + column.std() * np.array([-1.0, 1.0])
        return np.stack([ends, self.start + self.slope * ends], axis=1)


@dataclass(frozen=True)
class LineFinder:
    """Finds the line of a plane's echo in frames of one recording, each by itself.

    Attributes
    ----------
    pixel_mm : ndarray, shape (2,)
        Distance between columns and between rows.
    columns : Columns
        Sampled in every frame.
    """

    pixel_mm: FloatArray
    settings: LineSettings
    columns: Columns

    @classmethod
    def of_frames(
        cls,
        frames: Frames,
        pixel_mm: FloatArray,
        settings: LineSettings | None = None,
        region_px: npt.ArrayLike | None = None,
    ) -> LineFinder:
        """Choose the columns from all frames; see `detect_lines`."""
        s = settings or LineSettings()
        columns = choose_columns(frames, s.columns, region_px, s.smoothing_mm / pixel_mm[1])
        return cls(pixel_mm, s, columns)

    def line(self, image: AnyArray) -> EchoLine:
        """Find the line in one frame, shape (column, row).

        Raises
        ------
        InsufficientDataError
            If too few columns agree on a line.
        """
        s, columns = self.settings, self.columns
        samples, inside = np.asarray(image[columns.column], np.float32), columns.inside
        levels = samples[inside]
        if not (levels.size and 0 < np.ptp(levels) < np.inf):
            raise InsufficientDataError("no line: the image is of one level, or its values are not finite")
        row_mm = float(self.pixel_mm[1])
        tolerance, sigma, samples = s.tolerance_mm / row_mm, s.smoothing_mm / row_mm, columns.fill(samples)
        levels = gaussian_filter1d(samples, _FINE * sigma, truncate=_REACH, mode="nearest")
        slope = gaussian_filter1d(samples, sigma, order=1, truncate=_REACH, mode="nearest")
        slope[~inside] = 0.0
        peak = np.zeros(inside.shape, bool)
        peak[:, 1:-1] = inside[:, :-2] & inside[:, 1:-1] & inside[:, 2:]
        peak[:, 1:-1] &= (slope[:, 1:-1] > slope[:, :-2]) & (slope[:, 1:-1] >= slope[:, 2:])
        if s.threshold is None:
            peak &= slope > _LEAST * np.median(slope.max(axis=1))
            size = int(np.ceil(_AHEAD * sigma)) + 1
            bright = maximum_filter1d(levels, size, mode="nearest", origin=-(size // 2))
            # Every third row: enough for a median, in a third of the time.
            usual = np.median(levels[:, ::3][inside[:, ::3]])
            score = np.where(peak, np.maximum(bright - usual, np.float32(0.0)), np.float32(0.0))
            thresholds = [part * float(np.median(score.max(axis=1))) for part in _PARTS]
        else:
            score, thresholds = np.where(peak, slope, np.float32(0.0)), [s.threshold * row_mm]
        candidates: list[EchoLine] = []
        before = np.zeros(0, np.int64)
        for threshold in thresholds:
            above = score > threshold
            edge = np.where(above.any(axis=1), above.argmax(axis=1), score.argmax(axis=1))
            if np.array_equal(edge, before):
                continue  # neighbouring thresholds mostly find the same
            before = edge
            strength = score[np.arange(len(edge)), edge]
            row = _echo_rows(levels, slope, inside, edge, sigma, s.place)
            row[strength <= 0] = np.nan
            agree, possible, start, rise = consensus_line(
                columns.column.astype(float), row, inside, tolerance
            )
            mean = float(strength[agree].mean()) if agree.any() else 0.0
            edges = np.stack([columns.column, row], axis=1)
            candidates.append(EchoLine(edges[agree], possible, start, rise, mean))
        lines = [line for line in candidates if line.consensus >= self._least_consensus(line)]
        if not lines:
            best = max(candidates, key=lambda line: line.consensus)
            raise InsufficientDataError(
                f"no line: {best.consensus} of {best.possible} possible columns agree, "
                f"{self._least_consensus(best)} needed"
            )
        # The uppermost of those nearly as strong as the strongest, as most columns see it.
        middle, least = columns.column.mean(), _WEAKER * max(line.strength for line in lines)
        strong = [line for line in lines if line.strength >= least]
        depths = [line.start + line.slope * middle for line in strong]
        upper = [line for line, depth in zip(strong, depths, strict=True) if depth <= min(depths) + tolerance]
        return max(upper, key=lambda line: line.consensus)

    def _least_consensus(self, line: EchoLine) -> int:
        """Least number of columns that must agree on a line."""
        s = self.settings
        shares = s.consensus * line.possible, _LEAST_SHARE * len(self.columns.column)
        return max(3, *(int(np.ceil(share - 1e-9)) for share in shares))


def detect_lines(
    frames: Frames,
    pixel_mm: FloatArray,
    settings: LineSettings | None = None,
    region_px: npt.ArrayLike | None = None,
    progress: Progress | None = None,
) -> Detections:
    """Find the line of a plane's echo in every frame, read one at a time.

    Without a region, columns in which nothing ever changes are left out, and so is what stands still above
    everything that changes: the border and lettering of a recorded screen, and the transducer's ring-down.

    Parameters
    ----------
    frames : Frames, shape (n, column, row)
    pixel_mm : ndarray, shape (2,)
        Distance between columns and between rows.
    region_px : array_like, shape (k, 2), optional
        Corners (column, row) of a polygon outside which nothing counts.
    progress : callable, optional
        Called with the number of frames done and their total.

    Raises
    ------
    InvalidInputError
        If an argument is not what it must be.
    """
    finder = LineFinder.of_frames(frames, pixel_mm, settings, region_px)

    def find(image: AnyArray) -> tuple[FloatArray, FloatArray]:
        line = finder.line(image)
        return line.points_px[None], np.array([line.strength])

    detections = detect_in_frames(frames, find, progress)
    return replace(detections, pixels=detections.pixels.reshape(-1, 2, 2))


def consensus_line(
    column: FloatArray, row: FloatArray, inside: BoolArray, tolerance: float
) -> tuple[BoolArray, int, float, float]:
    """Fit a line to the points that agree on it, at first those of the best pair's line.

    Most points agree with the best pair's line; of equals, it is the one closest to them.

    Parameters
    ----------
    column, row : ndarray, shape (n,)
        Points; row NaN where there is none.
    inside : ndarray of bool, shape (n, r)
        Which rows of each column belong to the region; a line counts where it is in it.
    tolerance : float
        Rows above or below the line.

    Returns
    -------
    tuple of ndarray, int, float and float
        Which points agree, how many could, the line's row in column 0, and its slope; zeros without two.
    """

    def compare(start: npt.ArrayLike, slope: npt.ArrayLike) -> tuple[BoolArray, BoolArray, FloatArray]:
        """Which points agree with lines and which could, shape (lines, n), and the squares of the former."""
        at = np.add.outer(start, 0.0 * column) + np.multiply.outer(slope, column)
        nearest = np.floor(at + 0.5)
        could = (nearest >= 0) & (nearest < inside.shape[1])
        could &= inside[np.arange(column.size), np.where(could, nearest, 0).astype(np.int64)]
        off = row - at
        agree = could & (np.abs(off) <= tolerance)
        return agree, could, np.where(agree, off**2, 0.0).sum(axis=-1)

    points = np.flatnonzero(np.isfinite(row))
    if points.size < 2:
        return np.zeros(row.size, bool), 0, 0.0, 0.0
    j, k = points[np.stack(np.triu_indices(points.size, 1))]
    slopes = (row[k] - row[j]) / (column[k] - column[j])
    starts = row[j] - slopes * column[j]
    agree, _, squares = compare(starts, slopes)
    best = np.lexsort((squares, -agree.sum(axis=1)))[0]
    start, slope = float(starts[best]), float(slopes[best])
    agree, could, _ = compare(start, slope)
    for _ in range(_ROUNDS):
        if agree.sum() >= 3:
            slope, start = np.polyfit(column[agree], row[agree], 1).tolist()
            agree, could, _ = compare(start, slope)
    return agree, int(could.sum()), start, slope


def _echo_rows(
    levels: Float32Array, slope: Float32Array, inside: BoolArray, edge: IntArray, sigma: float, place: Place
) -> FloatArray:
    """Row of the line on the echo behind each column's edge; NaN without an echo."""
    column = np.arange(len(edge))
    steepest = edge + peak_between(slope, column, edge)
    if place == "slope":
        return steepest
    away = np.arange(-int(2.5 * sigma) - 1, int(2.0 * sigma) + 2)
    rows = edge[:, None] + away
    window = (rows >= 0) & (rows < levels.shape[1])
    rows = np.clip(rows, 0, levels.shape[1] - 1)
    window &= inside[column[:, None], rows]
    level = levels[column[:, None], rows].astype(float)
    # Up to `sigma` above the echo, where the edge is found, it is dark.
    above = window & (away <= -sigma)
    above[column, window.argmax(axis=1)] = True
    dark = (level * above).sum(axis=1) / np.maximum(above.sum(axis=1), 1)
    echo = np.where(window & (away >= -0.5 * sigma), level, -np.inf)
    at = echo.argmax(axis=1)
    half = 0.5 * (dark + level[column, at])
    bright = level[column, at] > half
    top = rows[column, at]
    if place == "peak":
        return np.where(bright, top + peak_between(levels, column, top), np.nan)
    below = window & (level < half[:, None]) & (np.arange(level.shape[1]) < at[:, None])
    last = level.shape[1] - 1 - below[:, ::-1].argmax(axis=1)
    after = np.minimum(last + 1, level.shape[1] - 1)
    low, high = level[column, last], level[column, after]
    front = rows[column, after] - (high - half) / np.where(high > low, high - low, 1.0)
    return np.where(bright & below.any(axis=1), front, np.nan)


def peak_between(values: Float32Array, column: IntArray, row: IntArray) -> FloatArray:
    """Offset of the maximum from a row, by the parabola through its neighbours."""
    row = np.clip(row, 1, values.shape[1] - 2)
    before, middle, after = (values[column, row + step].astype(float) for step in (-1, 0, 1))
    bend = before - 2.0 * middle + after
    return np.where(bend < 0.0, 0.5 * (before - after) / np.where(bend < 0.0, bend, -1.0), 0.0)
