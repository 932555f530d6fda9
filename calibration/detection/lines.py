"""Automatic detection of the straight line that a plane's echo makes in an image.

Each column is searched downwards for the first strong edge from dark to light; the line is the one that most
of these edges agree with. A frame in which too few agree is dropped, with the reason.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.detection.edges import Edges, first_echoes, take_profiles, typical
from calibration.detection.region import (
    DENSELY,
    Columns,
    checked_pixel,
    lay_columns,
    without_blank_sides,
    without_standing,
)
from calibration.points import Seen
from calibration.settings import LineSettings
from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.leastsquares import autocorrelation_time
from speckle3d.core.sweep import Frames
from speckle3d.kernels.lines import consensus_line

_PARTS = (0.95, 0.85, 0.75, 0.65, 0.5)
"""Least brightness of an echo when no threshold is given, as shares of the median of the columns' brightest
echoes: each is tried."""
_WEAKER = 0.75
"""Least brightness, as a share of the brightest line's, of a line that is preferred for lying above it: haze
and side lobes are fainter. The floor's reverberations lie beneath it and are no brighter."""
_LEAST_SHARE = 0.25
"""Share of all sampled columns that must agree, however few the line could meet: with a line that cuts a
corner of the region, two or three noisy edges always agree."""
_FINEST_ROWS = 0.1
"""Least scatter of an edge's place: the precision of interpolation between rows."""


class NoLineError(InsufficientDataError):
    """An image shows no line that can be trusted; the message says why."""


@dataclass(frozen=True)
class EchoLine:
    """The line of a plane's echo in one image.

    Attributes
    ----------
    points_px : ndarray, shape (2, 2)
        Column and row, fractional, of two points on the line: at the mean of the agreeing columns minus and
        plus their root mean square spread, where the errors of a fitted line are uncorrelated and equal.
    point_sd_mm : float
        Standard error of each point's depth; residuals of neighbouring columns may be correlated.
    direction_sd_rad : float
        Standard error of the line's direction in the image plane.
    consensus, possible : int
        Columns that agree, and sampled columns in which the line is inside the region.
    inlier_px : ndarray, shape (k, 2)
        Column and row of the edges that agree.
    """

    points_px: FloatArray
    point_sd_mm: float
    direction_sd_rad: float
    consensus: int
    possible: int
    inlier_px: FloatArray


def detect_line(
    image: npt.NDArray[Any],
    pixel_mm: npt.ArrayLike,
    settings: LineSettings | None = None,
    region_px: npt.ArrayLike | None = None,
) -> EchoLine:
    """Find the line of a plane's echo in one image.

    Parameters
    ----------
    image : ndarray, shape (column, row)
        Grey levels or amplitudes of any real type, rows down from the probe.
    pixel_mm : array_like, shape (2,)
        Distance between columns and between rows, mm; a few per cent do not matter.
    region_px : array_like, shape (k, 2), optional
        Corners (column, row) of a polygon outside which nothing counts; by default the image without blank
        columns at its sides.

    Raises
    ------
    NoLineError
        If too few columns agree on a line.
    InvalidInputError
        If an argument is not what it must be.
    """
    s = settings or LineSettings()
    if image.ndim != 2 or not np.isrealobj(image):
        raise InvalidInputError(f"image: expected real values (column, row), got {image.dtype} {image.shape}")
    pixel = checked_pixel(pixel_mm)
    if region_px is None:
        dense = lay_columns(image.shape, DENSELY * s.columns, None)
        columns = without_blank_sides(dense, image).thinned(s.columns)
    else:
        columns = lay_columns(image.shape, s.columns, region_px)
    return _detect(image, pixel, s, columns)


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
        pixel_mm: npt.ArrayLike,
        settings: LineSettings | None = None,
        region_px: npt.ArrayLike | None = None,
    ) -> LineFinder:
        """Choose the columns from all frames; see `detect_lines`."""
        s = settings or LineSettings()
        if len(frames.shape) != 3 or np.issubdtype(frames.dtype, np.complexfloating):
            raise InvalidInputError(
                f"frames: expected real values of shape (n, column, row), got {frames.dtype} of "
                f"{frames.shape}"
            )
        pixel = checked_pixel(pixel_mm)
        columns = lay_columns(frames.shape[1:], s.columns, region_px)
        if region_px is None and frames.shape[0] > 0:
            dense = lay_columns(frames.shape[1:], DENSELY * s.columns, None)
            columns = without_standing(dense, frames, s.smoothing_mm / pixel[1]).thinned(s.columns)
        return cls(pixel, s, columns)

    def line(self, image: npt.NDArray[Any]) -> EchoLine:
        """Find the line in one frame, shape (column, row).

        Raises
        ------
        NoLineError
            If too few columns agree on a line.
        """
        return _detect(image, self.pixel_mm, self.settings, self.columns)


def detect_lines(
    frames: Frames,
    pixel_mm: npt.ArrayLike,
    settings: LineSettings | None = None,
    region_px: npt.ArrayLike | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Seen:
    """Find the line of a plane's echo in every frame, read one at a time.

    Without a region, columns in which nothing ever changes are left out, and so is what stands still above
    everything that changes: the border and lettering of a recorded screen, and the transducer's ring-down.

    Parameters
    ----------
    frames : Frames, shape (n, column, row)
    pixel_mm, settings, region_px
        See `detect_line`.
    progress : callable, optional
        Called with the number of frames done and their total.

    Raises
    ------
    InvalidInputError
        If an argument is not what it must be.
    """
    finder = LineFinder.of_frames(frames, pixel_mm, settings, region_px)
    found: dict[int, FloatArray] = {}
    dropped: dict[int, str] = {}
    count = frames.shape[0]
    for index in range(count):
        try:
            found[index] = finder.line(frames[index]).points_px
        except NoLineError as error:
            dropped[index] = str(error)
        if progress:
            progress(index + 1, count)
    points = np.reshape(list(found.values()), (-1, 2, 2))
    return Seen(np.array(list(found), dtype=np.int64), points, dropped=dropped)


@dataclass(frozen=True)
class _Candidate:
    """A line that some columns' edges agree with."""

    edges: Edges
    agree: BoolArray
    possible: int
    start: float
    slope: float

    @property
    def agreed(self) -> int:
        return int(self.agree.sum())

    @property
    def strength(self) -> float:
        return float(self.edges.strength[self.agree].mean())


def _detect(image: npt.NDArray[Any], pixel_mm: FloatArray, s: LineSettings, columns: Columns) -> EchoLine:
    samples = np.asarray(image[columns.column], np.float32)
    held = samples[columns.inside]
    if not np.isfinite(held).all():
        raise NoLineError("no line: the image holds values that are not finite")
    if held.size == 0 or np.ptp(held) == 0:
        raise NoLineError("no line: the image is of one level all over")
    tolerance = s.tolerance_mm / float(pixel_mm[1])
    profiles = take_profiles(samples, columns, s.smoothing_mm / float(pixel_mm[1]))
    if s.threshold is None:
        score = profiles.brightness()
        thresholds = [part * typical(score, columns) for part in _PARTS]
    else:
        score, thresholds = profiles.slope, [s.threshold * float(pixel_mm[1])]
    echoes = [first_echoes(profiles, score, threshold, s.place) for threshold in thresholds]
    tried = [_consensus(edges, columns, tolerance) for edges in _distinct(echoes)]
    accepted = [line for line in tried if line.agreed >= _needed(line, columns, s)]
    if not accepted:
        best = max(tried, key=lambda line: line.agreed)
        raise NoLineError(
            f"no line: {best.agreed} of {best.possible} possible columns agree, "
            f"{_needed(best, columns, s)} needed"
        )
    return _measured(_first_strong(accepted, columns, tolerance), columns, pixel_mm)


def _distinct(echoes: list[Edges]) -> list[Edges]:
    """Leave out edges equal to those before them: neighbouring thresholds mostly find the same."""
    kept = echoes[:1]
    for edges in echoes[1:]:
        if not np.array_equal(edges.row, kept[-1].row, equal_nan=True):
            kept.append(edges)
    return kept


def _needed(line: _Candidate, columns: Columns, s: LineSettings) -> int:
    shares = s.consensus * line.possible, _LEAST_SHARE * columns.held
    return max(3, *(int(np.ceil(share - 1e-9)) for share in shares))


def _first_strong(lines: list[_Candidate], columns: Columns, tolerance: float) -> _Candidate:
    """The uppermost of the lines nearly as strong as the strongest, as most columns see it."""
    least = _WEAKER * max(line.strength for line in lines)
    middle = float(columns.column.mean())
    depths = {id(line): line.start + line.slope * middle for line in lines if line.strength >= least}
    upper = [line for line in lines if depths.get(id(line), np.inf) <= min(depths.values()) + tolerance]
    return max(upper, key=lambda line: line.agreed)


def _consensus(edges: Edges, columns: Columns, tolerance: float) -> _Candidate:
    agree = np.zeros(edges.row.size, dtype=bool)
    column = columns.column.astype(float)
    possible, start, slope = consensus_line(column, edges.row, columns.inside, tolerance, agree)
    return _Candidate(edges, agree, possible, start, slope)


def _measured(line: _Candidate, columns: Columns, pixel_mm: FloatArray) -> EchoLine:
    # Errors of a fit's level at the mean column and of its slope are uncorrelated. At one standard deviation
    # of the columns to either side both contribute equally, so that the two points' errors are uncorrelated.
    x, y = columns.column[line.agree].astype(float), line.edges.row[line.agree]
    spread = float(x.std())
    ends = x.mean() + spread * np.array([-1.0, 1.0])
    residual = line.edges.row - line.start - line.slope * columns.column
    level_sd_mm = _level_sd(np.where(line.agree, residual, np.nan)) * float(pixel_mm[1])
    steepness = line.slope * pixel_mm[1] / pixel_mm[0]
    return EchoLine(
        points_px=np.stack([ends, line.start + line.slope * ends], axis=1),
        point_sd_mm=float(np.sqrt(2.0) * level_sd_mm),
        direction_sd_rad=float(level_sd_mm / (spread * pixel_mm[0]) / (1 + steepness**2)),
        consensus=line.agreed,
        possible=line.possible,
        inlier_px=np.stack([x, y], axis=1),
    )


def _level_sd(residual: FloatArray) -> float:
    """Standard error of the mean of residuals (NaN where missing) that may be correlated with neighbours."""
    there = np.isfinite(residual)
    count = float(there.sum())
    energy = float(np.maximum(np.nansum(residual**2), count * _FINEST_ROWS**2))
    likeness = float(np.minimum(autocorrelation_time(residual, energy), count / 4))
    # The line itself took two of as many free residuals as there are independent ones.
    return float(np.sqrt(energy / (count - 2.0 * likeness) * likeness / count))
