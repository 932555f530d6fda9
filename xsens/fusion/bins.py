"""Steps of the filter averaged to bins, of which the heading's filter takes one reading each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.kernels.orientation.heading import BIN
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


def filtered_bins(steps: FilterSteps, settings: FusionSettings) -> Any:
    """Average the steps of each bin as the filter left them, with its corrections of its tilt."""
    bins = averaged_bins(steps, steps.start, steps.bias_rad_s, steps.bias_sd_rad_s, steps.sd_rad, settings)
    lasts = lasts_of_bins(steps, settings)
    firsts = np.append(0, lasts[:-1] + 1)
    corrections = steps.corrected @ np.swapaxes(steps.predicted, 1, 2)
    turns = corrections[firsts]
    for i in range(1, steps_per_bin(settings)):
        there = firsts + i <= lasts
        turns[there] = corrections[firsts[there] + i] @ turns[there]
    bins["correction"] = turns
    return bins


def averaged_bins(
    steps: FilterSteps,
    level: FloatArray,
    bias_rad_s: FloatArray,
    bias_sd_rad_s: FloatArray,
    sd_rad: FloatArray,
    settings: FusionSettings,
) -> Any:
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
    structured ndarray, shape (bins,), of `BIN`
        Fields as they were read, not yet over their norm; no corrections.
    """
    lasts = lasts_of_bins(steps, settings)
    firsts, counts = np.append(0, lasts[:-1] + 1), np.diff(lasts, prepend=-1)
    bins = np.zeros(len(lasts), BIN)
    bins["span_s"] = np.add.reduceat(steps.duration_s, firsts)
    bins["resting"] = np.logical_and.reduceat(steps.resting, firsts)
    bins["slip_rad2"] = np.add.reduceat(steps.slip_rad2, firsts)
    bins["bias_variance"] = (bias_sd_rad_s[lasts] ** 2).mean(axis=1) + settings.moving_bias_rad_s**2
    bins["tilt_rad2"] = np.add.reduceat((sd_rad[:, :2] ** 2).mean(axis=1), firsts) / counts
    bins["correction"] = np.eye(3)
    seen = np.asarray(np.isfinite(steps.field_au).all(axis=1))
    bins["seen"] = np.logical_or.reduceat(seen, firsts)
    field = np.where(seen[:, None], steps.field_au, 0.0)
    rate = np.cross(steps.rate_rad_s - bias_rad_s, field)
    weight = np.where(np.repeat(bins["seen"], counts), seen, 1.0)
    for name, values in (
        ("field", np.einsum("kij,kj->ki", level, field)),
        ("field_rate", np.einsum("kij,kj->ki", level, rate)),
        ("level", level),
    ):
        flat = weight[:, None] * values.reshape(len(values), -1)
        mean = np.add.reduceat(flat, firsts) / np.add.reduceat(weight, firsts)[:, None]
        bins[name] = mean.reshape(bins[name].shape)
    return bins
