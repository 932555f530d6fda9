"""Orientation of a stretch without a pause: inclination, then heading, at every sample."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from xsens.fusion.bins import averaged_bins, filtered_bins, lasts_of_bins, steps_per_bin
from xsens.fusion.heading import HeadingFilter, Headings
from xsens.fusion.inclination import CLAIMED, FilterSteps, forward, fresh_filter, smooth, within_steps
from xsens.fusion.samples import Estimate, Samples
from xsens.fusion.settings import FusionSettings


class StretchFilter:
    """The filter over one stretch after another; bias, iron and lag are kept from each to the next."""

    def __init__(self, settings: FusionSettings) -> None:
        self._settings = settings
        self._level = fresh_filter(settings)
        self._heading = HeadingFilter(settings)

    def run(self, samples: Samples, pause_s: float) -> Estimate:
        """Orientation of the next stretch, `pause_s` after the last, by the readings so far."""
        settings = self._settings
        steps = forward(samples, settings, self._level, pause_s)
        rows, starts, sd, headings = steps.rows, steps.rows["start"], steps.rows["sd"][:, :3] * CLAIMED, None
        if settings.use_magnetometer:
            self._heading.resume()
            ends = rows["bias"][lasts_of_bins(len(rows), settings)]
            # A step turns by the heading of the last whole bin; those of the first bin by its own.
            known = np.maximum(np.arange(len(rows)) // steps_per_bin(settings) - 1, 0)
            headings = self._heading.follow(filtered_bins(rows, settings), ends)[known]
            starts = _turned(headings.turn_rad, starts)
            sd[:, 2] = headings.sd_rad
        xyzw = within_steps(samples, steps, np.ascontiguousarray(starts), rows["start_bias"])
        return _each_sample(steps, xyzw, sd, rows["bias"], headings)


def smoothed(samples: Samples, settings: FusionSettings) -> Estimate:
    """Orientation of a stretch by all its readings; it must be longer than a second."""
    steps, level = smooth(samples, settings)
    rows, nodes, sd, headings = steps.rows, level.levels, level.sd_rad, None
    if settings.use_magnetometer and np.isfinite(rows["field"][:, 0]).any():
        bias, bias_sd = level.bias_rad_s[1:], level.bias_sd_rad_s[1:]
        bins = averaged_bins(rows, nodes[:-1], bias, bias_sd, sd[1:], settings)
        found = HeadingFilter(settings, online=False).smooth(bins)
        time_s = np.concatenate([[0.0], np.cumsum(rows["duration_s"])])
        ends_s = time_s[1:][lasts_of_bins(len(rows), settings)]
        nodes = _turned(np.interp(time_s, ends_s, np.unwrap(found.turn_rad)), nodes)
        sd[:, 2] = np.interp(time_s, ends_s, found.sd_rad)
        headings = found[np.arange(len(rows)) // steps_per_bin(settings)]
    elif settings.use_magnetometer:
        sd[:, 2] = np.pi
    xyzw = within_steps(samples, steps, nodes[:-1], level.bias_rad_s[:-1], nodes[1:])
    return _each_sample(steps, xyzw, sd[1:], level.bias_rad_s[1:], headings)


def _turned(angles_rad: FloatArray, xyzw: FloatArray) -> FloatArray:
    """Quaternions, shape (k, 4), turned about up."""
    return (Rotation.from_euler("z", angles_rad[:, None]) * Rotation.from_quat(xyzw)).as_quat()


def _each_sample(
    steps: FilterSteps,
    xyzw: FloatArray,
    sd_rad: FloatArray,
    bias_rad_s: FloatArray,
    headings: Headings | None,
) -> Estimate:
    """Give every sample what was found for its step."""
    count = len(steps.last)
    each = np.diff(steps.last, prepend=0)
    field = (np.zeros(count, dtype=bool), np.full(count, np.nan), np.full(count, np.nan))
    if headings is not None:
        field = headings.disturbed, headings.stray, headings.iron
    disturbed, stray, iron = field
    found = (sd_rad, bias_rad_s, disturbed, steps.rows["resting"], stray, iron)
    return Estimate(xyzw, *(np.repeat(values, each, axis=0) for values in found))
