"""Steps of the filter averaged to bins, of which the heading's filter takes one reading each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.kernels.orientation import heading_arrays as at
from xsens.fusion.settings import FusionSettings

if TYPE_CHECKING:
    from xsens.fusion.inclination import FilterSteps

BIN_S = 0.25
"""Readings are averaged over this time: the heading's error changes in seconds."""


def steps_per_bin(settings: FusionSettings) -> int:
    """Steps of the filter in a bin."""
    return max(1, round(BIN_S / settings.block_s))


def lasts_of_bins(steps: FilterSteps, settings: FusionSettings) -> IntArray:
    """Last step of each bin; the last bin may be shorter."""
    per_bin, n = steps_per_bin(settings), len(steps.last)
    return np.minimum(np.arange(per_bin, n + per_bin, per_bin), n) - 1


def filtered_bins(steps: FilterSteps, settings: FusionSettings) -> tuple[FloatArray, FloatArray]:
    """Average the steps of each bin as the filter left them.

    Returns
    -------
    bins : ndarray, shape (bins, BIN)
        As of `averaged_bins`, with the filter's corrections of its tilt.
    bias_rad_s : ndarray, shape (bins, 3)
        At the end of each bin.
    """
    level, bias, bias_sd, sd = steps.start, steps.bias_rad_s, steps.bias_sd_rad_s, steps.sd_rad
    rows = averaged_bins(steps, level, bias, bias_sd, sd, settings)
    lasts = lasts_of_bins(steps, settings)
    firsts = np.append(0, lasts[:-1] + 1)
    corrections = steps.corrected @ np.swapaxes(steps.predicted, 1, 2)
    turns = corrections[firsts]
    for i in range(1, steps_per_bin(settings)):
        there = firsts + i <= lasts
        turns[there] = corrections[firsts[there] + i] @ turns[there]
    rows[:, at.CORRECTION : at.CORRECTION + 9] = turns.reshape(-1, 9)
    return rows, bias[lasts]


def averaged_bins(
    steps: FilterSteps,
    level: FloatArray,
    bias_rad_s: FloatArray,
    bias_sd_rad_s: FloatArray,
    sd_rad: FloatArray,
    settings: FusionSettings,
) -> FloatArray:
    """Average the steps of each bin.

    Parameters
    ----------
    steps : FilterSteps, length n
    level : ndarray, shape (n, 3, 3)
        Level axes from the sensor's at the start of each step.
    bias_rad_s, bias_sd_rad_s : ndarray, shape (n, 3)
        After each step.
    sd_rad : ndarray, shape (n, 3)
        Deviation of the level axes about the world's; the third is not used.
    settings : FusionSettings

    Returns
    -------
    ndarray, shape (bins, BIN)
        See `heading_arrays`; fields as they were read, not yet over their norm; no corrections.
    """
    lasts = lasts_of_bins(steps, settings)
    firsts, counts = np.append(0, lasts[:-1] + 1), np.diff(lasts, prepend=-1)
    rows = np.zeros((len(lasts), at.BIN))
    rows[:, at.SPAN] = np.add.reduceat(steps.duration_s, firsts)
    rows[:, at.RESTS] = np.logical_and.reduceat(steps.resting, firsts)
    rows[:, at.SLIP] = np.add.reduceat(steps.slip_rad2, firsts)
    rows[:, at.BIAS_VARIANCE] = (bias_sd_rad_s[lasts] ** 2).mean(axis=1) + settings.moving_bias_rad_s**2
    rows[:, at.SEEN], rows[:, at.READING : at.TILT] = _mean_readings(steps, level, bias_rad_s, firsts, counts)
    rows[:, at.TILT] = np.add.reduceat((sd_rad[:, :2] ** 2).mean(axis=1), firsts) / counts
    rows[:, at.CORRECTION : at.CORRECTION + 9] = np.eye(3).ravel()
    return rows


def _mean_readings(
    steps: FilterSteps, level: FloatArray, bias_rad_s: FloatArray, firsts: IntArray, counts: IntArray
) -> tuple[BoolArray, FloatArray]:
    """Bins with a field, and means of field, level axes and the field's rate over the steps that have one."""
    seen = np.asarray(np.isfinite(steps.field_au).all(axis=1))
    field = np.where(seen[:, None], steps.field_au, 0.0)
    field_rate = np.cross(steps.rate_rad_s - bias_rad_s, field)
    columns = np.column_stack(
        [
            np.einsum("kij,kj->ki", level, field),
            level.reshape(-1, 9),
            np.einsum("kij,kj->ki", level, field_rate),
        ]
    )
    any_seen = np.asarray(np.logical_or.reduceat(seen, firsts))
    weight = np.where(np.repeat(any_seen, counts), seen, 1.0)
    sums = np.add.reduceat(weight[:, None] * columns, firsts)
    return any_seen, sums / np.add.reduceat(weight, firsts)[:, None]
