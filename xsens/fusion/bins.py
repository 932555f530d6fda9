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


def averaged_bins(
    rows: Any, levels: FloatArray, bias_rad_s: FloatArray, sd: FloatArray, settings: FusionSettings
) -> Any:
    """Average the steps of each bin.

    Parameters
    ----------
    rows : structured ndarray, shape (n,)
        As in `xsens.fusion.inclination.FilterSteps`.
    levels : ndarray, shape (n, 4)
        Level axes from the sensor's at the start of each step.
    bias_rad_s : ndarray, shape (n, 3)
        After each step.
    sd : ndarray, shape (n, 6)
        Deviation of the level axes about the world's, rad, of which the third is not used, and of the bias.
    settings : FusionSettings

    Returns
    -------
    structured ndarray, shape (bins,), of `BIN`
    """
    lasts = lasts_of_bins(len(rows), settings)
    firsts, counts = np.append(0, lasts[:-1] + 1), np.diff(lasts, prepend=-1)
    bins = np.zeros(len(lasts), BIN)
    bins["span_s"] = np.add.reduceat(rows["duration_s"], firsts)
    bins["resting"] = np.logical_and.reduceat(rows["resting"], firsts)
    bins["slip_rad2"] = np.add.reduceat(rows["noise"][:, 2], firsts)
    bins["bias"] = bias_rad_s[lasts]
    bins["bias_variance"] = (sd[lasts, 3:] ** 2).mean(axis=1) + settings.moving_bias_rad_s**2
    bins["tilt_rad2"] = np.add.reduceat((sd[:, :2] ** 2).mean(axis=1), firsts) / counts
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
