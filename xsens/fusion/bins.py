"""Steps of the filter averaged to bins, of which the heading's filter takes one reading each."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.kernels.orientation.heading import BIN
from xsens.fusion.settings import FusionSettings

BIN_S = 0.25
"""Readings are averaged over this time: the heading's error changes in seconds."""


def steps_per_bin(settings: FusionSettings) -> int:
    """Steps of the filter in a bin."""
    return max(1, round(BIN_S / settings.block_s))


def lasts_of_bins(steps: int, settings: FusionSettings) -> IntArray:
    """Last step of each bin; the last bin may be shorter."""
    per_bin = steps_per_bin(settings)
    return np.minimum(np.arange(per_bin, steps + per_bin, per_bin), steps) - 1


def filtered_bins(rows: Any, settings: FusionSettings) -> Any:
    """Average the steps of each bin as the filter left them, with its corrections of its tilt."""
    sd = rows["sd"]
    bins = averaged_bins(rows, rows["start"], rows["bias"], sd[:, 3:6], sd[:, :3], settings)
    turns = Rotation.from_quat(rows["level"]) * Rotation.from_quat(rows["predicted"]).inv()
    lasts = lasts_of_bins(len(rows), settings)
    firsts = np.append(0, lasts[:-1] + 1)
    # Corrections are small: the turn of all is the sum of their rotation vectors.
    bins["correction"] = Rotation.from_rotvec(np.add.reduceat(turns.as_rotvec(), firsts)).as_matrix()
    return bins


def averaged_bins(
    rows: Any,
    levels: FloatArray,
    bias_rad_s: FloatArray,
    bias_sd_rad_s: FloatArray,
    sd_rad: FloatArray,
    settings: FusionSettings,
) -> Any:
    """Average the steps of each bin.

    Parameters
    ----------
    rows : structured ndarray, shape (n,)
        As in `FilterSteps`.
    levels : ndarray, shape (n, 4)
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
    lasts = lasts_of_bins(len(rows), settings)
    firsts, counts = np.append(0, lasts[:-1] + 1), np.diff(lasts, prepend=-1)
    bins = np.zeros(len(lasts), BIN)
    bins["span_s"] = np.add.reduceat(rows["duration_s"], firsts)
    bins["resting"] = np.logical_and.reduceat(rows["resting"], firsts)
    bins["slip_rad2"] = np.add.reduceat(rows["noise"][:, 2], firsts)
    bins["bias_variance"] = (bias_sd_rad_s[lasts] ** 2).mean(axis=1) + settings.moving_bias_rad_s**2
    bins["tilt_rad2"] = np.add.reduceat((sd_rad[:, :2] ** 2).mean(axis=1), firsts) / counts
    bins["correction"] = np.eye(3)
    seen = np.asarray(np.isfinite(rows["field"]).all(axis=1))
    bins["seen"] = np.logical_or.reduceat(seen, firsts)
    field = np.where(seen[:, None], rows["field"], 0.0)
    level = Rotation.from_quat(levels)
    weight = np.where(np.repeat(bins["seen"], counts), seen, 1.0)
    for name, values in (
        ("field", level.apply(field)),
        ("field_rate", level.apply(np.cross(rows["rate"] - bias_rad_s, field))),
        ("level", level.as_matrix()),
    ):
        flat = weight[:, None] * values.reshape(len(values), -1)
        mean = np.add.reduceat(flat, firsts) / np.add.reduceat(weight, firsts)[:, None]
        bins[name] = mean.reshape(bins[name].shape)
    return bins
