"""The echo of a plane in an image: a straight line, found without help.

Columns are looked down for the first strong edge from dark to light, and the line is the one most of these
edges agree with. A frame in which too few agree has no line, and says why.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from calibration.columns import (
    BoolArray,
    Columns,
    IntArray,
    lay_columns,
    without_blank_sides,
    without_standing,
)
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.geometry import FloatArray
from speckle3d.core.sweep import Frames
from speckle3d.kernels.lines import agreeing, best_pair, echo_fronts, edge_response, first_edges

Float32Array = npt.NDArray[np.float32]

_TYPICAL = 0.5
"""Threshold, when chosen from the image, as a part of the response of the middle column's strongest edge."""
_LEAST_SHARE = 0.25
"""Part of the sampled columns that must agree however few the line could meet: two or three edges, which are
noise, always agree with a line that cuts a corner of the region."""
_FINE = 0.25
"""Smoothing with which the front of an echo is placed, as a part of that with which it is found: enough
against noise, and short against the rise of an echo."""
_REACH = 3.5
"""Length of the filters' sides, standard deviations."""
_FINEST_ROWS = 0.1
"""Scatter below which an edge is not placed: interpolation between rows is not better."""
_ROUNDS = 20


class LineSettings(BaseModel):
    """How the line of a plane's echo is found, [1]_ appendix B.

    References
    ----------
    .. [1] Prager et al., CUED/F-INFENG/TR 303, 1997.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    columns: int = Field(60, ge=5, description="Columns sampled, at regular intervals.")
    smoothing_mm: float = Field(
        0.7, gt=0, description="Standard deviation of the Gaussian along a column whose slope shows edges."
    )
    threshold: float | None = Field(
        None,
        gt=0,
        description="Slope that makes an edge, grey levels per mm; by default half the largest in the middle "
        "of all columns.",
    )
    tolerance_mm: float = Field(0.5, gt=0, description="How far above or below the line an edge agrees.")
    consensus: float = Field(
        0.7, gt=0, le=1, description="Part that must agree of the columns whose region the line meets."
    )
    place: Literal["front", "slope", "peak"] = Field(
        "front",
        description="Where on an echo the line is put: where it has risen half way, where the smoothed image "
        "is steepest (up to smoothing_mm above a thin echo), or where it is brightest.",
    )


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
        Standard error of each point's depth, neighbouring columns' likeness accounted for.
    direction_sd_rad : float
        Standard error of the line's direction in the image plane.
    consensus, possible : int
        Columns that agree, and sampled columns whose region the line meets.
    inlier_px : ndarray, shape (k, 2)
        Column and row of the edges that agree.
    """

    points_px: FloatArray
    point_sd_mm: float
    direction_sd_rad: float
    consensus: int
    possible: int
    inlier_px: FloatArray


@dataclass(frozen=True)
class EchoLines:
    """The lines of a sequence.

    Attributes
    ----------
    frame : ndarray of int, shape (m,)
        Numbers of the frames with a line, ascending.
    points_px : ndarray, shape (m, 2, 2)
    point_sd_mm, direction_sd_rad : ndarray, shape (m,)
        See `EchoLine`.
    dropped : dict of int to str
        Why each other frame has none.
    """

    frame: IntArray
    points_px: FloatArray
    point_sd_mm: FloatArray
    direction_sd_rad: FloatArray
    dropped: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return int(self.frame.size)


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
    if image.ndim != 2:
        raise InvalidInputError(f"image: expected shape (column, row), got {image.shape}")
    columns = lay_columns(image.shape, s.columns, region_px)
    samples = _sampled(image, columns)
    if region_px is None:
        columns = without_blank_sides(columns, samples)
    return _detect(samples, _checked_pixel(pixel_mm), s, columns)


def detect_lines(
    frames: Frames,
    pixel_mm: npt.ArrayLike,
    settings: LineSettings | None = None,
    region_px: npt.ArrayLike | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> EchoLines:
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
    s = settings or LineSettings()
    pixel = _checked_pixel(pixel_mm)
    columns = lay_columns(frames.shape[1:], s.columns, region_px)
    if region_px is None and frames.shape[0] > 0:
        columns = without_standing(columns, frames, s.smoothing_mm / pixel[1])
    found: dict[int, EchoLine] = {}
    dropped: dict[int, str] = {}
    count = frames.shape[0]
    for index in range(count):
        try:
            found[index] = _detect(_sampled(frames[index], columns), pixel, s, columns)
        except NoLineError as error:
            dropped[index] = str(error)
        if progress:
            progress(index + 1, count)
    lines = list(found.values())
    return EchoLines(
        frame=np.array(list(found), dtype=np.int64),
        points_px=np.reshape([line.points_px for line in lines], (-1, 2, 2)),
        point_sd_mm=np.array([line.point_sd_mm for line in lines]),
        direction_sd_rad=np.array([line.direction_sd_rad for line in lines]),
        dropped=dropped,
    )


def _checked_pixel(pixel_mm: npt.ArrayLike) -> FloatArray:
    pixel = np.asarray(pixel_mm, dtype=float)
    if pixel.shape != (2,) or not (np.isfinite(pixel) & (pixel > 0)).all():
        raise InvalidInputError(f"pixel_mm: expected two values above zero, got {pixel.tolist()}")
    return pixel


def _sampled(image: npt.NDArray[Any], columns: Columns) -> Float32Array:
    if not np.isrealobj(image):
        raise InvalidInputError(f"image: expected real values, got {image.dtype}")
    return np.asarray(image[columns.column], dtype=np.float32)


def _detect(samples: Float32Array, pixel_mm: FloatArray, s: LineSettings, columns: Columns) -> EchoLine:
    _require_content(samples[columns.inside])
    column = columns.column.astype(float)
    row = _echo_rows(samples, columns.spans, s, s.smoothing_mm / pixel_mm[1])
    fit, agree, possible = _consensus(column, row, columns.inside, s.tolerance_mm / pixel_mm[1])
    agreed = int(agree.sum())
    needed = max(3, *(int(np.ceil(x - 1e-9)) for x in (s.consensus * possible, _LEAST_SHARE * columns.held)))
    if agreed < needed:
        raise NoLineError(f"no line: {agreed} of {possible} possible columns agree, {needed} needed")
    return _measured(column, row, agree, fit, possible, pixel_mm)


def _require_content(held: Float32Array) -> None:
    if not np.isfinite(held).all():
        raise NoLineError("no line: the image holds values that are not finite")
    if held.size == 0 or np.ptp(held) == 0:
        raise NoLineError("no line: the image is of one level all over")


def _consensus(
    column: FloatArray, row: FloatArray, inside: BoolArray, tolerance: float
) -> tuple[tuple[float, float], BoolArray, int]:
    """Start and slope of the line most points agree with, fitted to them; which do, and how many could."""
    agree = np.zeros(row.size, dtype=bool)
    agreed, start, slope = best_pair(column, row, inside, tolerance)
    agreed, possible, _ = agreeing(column, row, inside, start, slope, tolerance, agree)
    for _ in range(_ROUNDS):
        if agreed < 3:
            break
        before = agree.copy()
        slope, start = np.polyfit(column[agree], row[agree], 1)
        agreed, possible, _ = agreeing(column, row, inside, start, slope, tolerance, agree)
        if np.array_equal(before, agree):
            break
    return (start, slope), agree, possible


def _echo_rows(samples: Float32Array, spans: IntArray, s: LineSettings, sigma: float) -> FloatArray:
    """Row of the first strong echo in each column, shape (n,); NaN where there is none."""
    response = np.empty_like(samples)
    t = np.arange(1, int(np.ceil(_REACH * sigma)) + 1)
    taps = t * np.exp(-0.5 * (t / sigma) ** 2)
    edge_response(samples, spans, (taps / (2 * t * taps).sum()).astype(np.float32), response)
    largest = response.max(axis=1)[np.unique(spans[:, 0])]
    typical = _TYPICAL * np.median(largest)
    # The response is per row.
    limit = typical if s.threshold is None else s.threshold * s.smoothing_mm / sigma
    edges, fronts, peaks = np.empty((3, len(samples)))
    found = np.empty(len(samples), np.int64)
    first_edges(response, spans, float(limit), edges, found)
    if s.place == "slope":
        return np.asarray(edges)
    t = np.arange(int(np.ceil(_REACH * _FINE * sigma)) + 1)
    fine = np.exp(-0.5 * (t / (_FINE * sigma)) ** 2)
    fine /= 2 * fine.sum() - 1
    echo_fronts(samples, spans, found, edges, fine.astype(np.float32), sigma, fronts, peaks)
    return np.asarray(fronts if s.place == "front" else peaks)


def _measured(
    column: FloatArray,
    row: FloatArray,
    agree: BoolArray,
    line: tuple[float, float],
    possible: int,
    pixel_mm: FloatArray,
) -> EchoLine:
    """The line with its errors."""
    # Errors of a fit's level at the mean column and of its slope are uncorrelated. One spread to either side
    # both count the same, so that their sum and their difference are uncorrelated, too.
    start, slope = line
    x, y = column[agree], row[agree]
    spread = float(x.std())
    ends = x.mean() + spread * np.array([-1.0, 1.0])
    residual = np.full(row.size, np.nan)
    residual[agree] = y - start - slope * x
    level_sd_mm = _level_sd(residual) * pixel_mm[1]
    steepness = slope * pixel_mm[1] / pixel_mm[0]
    return EchoLine(
        points_px=np.stack([ends, start + slope * ends], axis=1),
        point_sd_mm=float(np.sqrt(2.0) * level_sd_mm),
        direction_sd_rad=float(level_sd_mm / (spread * pixel_mm[0]) / (1 + steepness**2)),
        consensus=int(agree.sum()),
        possible=possible,
        inlier_px=np.stack([x, y], axis=1),
    )


def _level_sd(residual: FloatArray) -> float:
    """Standard error of the mean of residuals (NaN where missing) that may resemble their neighbours."""
    there = np.isfinite(residual)
    count = float(there.sum())
    r = np.where(there, residual, 0.0)
    energy = max(float(r @ r), count * _FINEST_ROWS**2)
    likeness = 1.0
    for lag in range(1, int(count) // 4):
        pairs = max(1, np.count_nonzero(there[lag:] & there[:-lag]))
        rho = float(r[lag:] @ r[:-lag]) / pairs / (energy / count)
        if rho <= 0:
            break
        likeness += 2.0 * rho * (1 - lag / count)
    likeness = min(likeness, count / 4)
    # The line itself took two of as many free residuals as there are independent ones.
    return float(np.sqrt(energy / (count - 2.0 * likeness) * likeness / count))
