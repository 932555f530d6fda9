"""Orientation of a stretch without a pause: inclination, then heading, at every sample."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from xsens.fusion.heading import HeadingBank, Headings, bins_of, smooth_headings, steps_per_bin
from xsens.fusion.inclination import FilterSteps, forward, fresh_filter, smooth, within_steps
from xsens.fusion.samples import Estimate, Samples
from xsens.fusion.settings import FusionSettings


class StretchFilter:
    """The filter over one stretch after another; bias, iron and lag are kept from each to the next."""

    def __init__(self, settings: FusionSettings) -> None:
        self._settings = settings
        self._level = fresh_filter(settings)
        self._bank = HeadingBank(settings)
        self._ran = False

    def run(self, samples: Samples, pause_s: float) -> Estimate:
        """Orientation of the next stretch, `pause_s` after the last, by the readings so far."""
        settings = self._settings
        magnetic = settings.use_magnetometer
        steps = forward(samples, settings, self._level, pause_s, heading_apart=magnetic)
        starts, sd = steps.start, steps.sd_rad
        disturbed = np.zeros(len(starts), dtype=bool)
        if magnetic:
            if self._ran:
                self._bank.resume()
            bins = bins_of(steps, starts, steps.bias, steps.bias_sd_rad_s, sd, settings, corrected=True)
            lasts = _lasts(steps, settings)
            found = self._bank.follow(bins, steps.bias[lasts])
            # A step turns by the heading of the last whole bin; those of the first bin by its own.
            known = np.maximum(_bin_of(steps, settings) - 1, 0)
            starts = _turned(found.turn_rad[known], starts)
            sd = np.column_stack([sd[:, :2], found.sd_rad[known]])
            disturbed = found.disturbed[known]
        self._ran = True
        xyzw = within_steps(steps, starts, steps.start_bias)
        return _each_sample(steps, xyzw, sd, steps.bias, disturbed)


def smoothed(samples: Samples, settings: FusionSettings) -> Estimate:
    """Orientation of a stretch by all its readings; it must be longer than a second."""
    steps, level = smooth(samples, settings)
    nodes, sd = level.matrices, level.sd_rad
    disturbed = np.zeros(len(steps.last), dtype=bool)
    if settings.use_magnetometer and np.isfinite(steps.field_au[:, 0]).any():
        bins = bins_of(steps, nodes[:-1], level.bias_rad_s[1:], level.bias_sd_rad_s[1:], sd[1:], settings)
        found = smooth_headings(bins, settings)
        turn, heading_sd = _at_nodes(steps, found, settings)
        nodes = _turned(turn, nodes)
        sd = np.column_stack([sd[:, :2], heading_sd])
        disturbed = found.disturbed[_bin_of(steps, settings)]
    elif settings.use_magnetometer:
        sd = np.column_stack([sd[:, :2], np.full(len(sd), np.pi)])
    xyzw = within_steps(steps, nodes[:-1], level.bias_rad_s[:-1], nodes[1:])
    return _each_sample(steps, xyzw, sd[1:], level.bias_rad_s[1:], disturbed)


def _turned(angles_rad: FloatArray, matrices: FloatArray) -> FloatArray:
    """Rotations, shape (k, 3, 3), turned about up."""
    turns = Rotation.from_euler("z", angles_rad[:, None]).as_matrix()
    return np.asarray(turns @ matrices)


def _bin_of(steps: FilterSteps, settings: FusionSettings) -> IntArray:
    return np.asarray(np.arange(len(steps.last)) // steps_per_bin(settings))


def _lasts(steps: FilterSteps, settings: FusionSettings) -> IntArray:
    """Last step of each bin."""
    per_bin, n = steps_per_bin(settings), len(steps.last)
    return np.minimum(np.arange(per_bin, n + per_bin, per_bin), n) - 1


def _at_nodes(steps: FilterSteps, found: Headings, settings: FusionSettings) -> tuple[FloatArray, FloatArray]:
    """Angle to north and its deviation at the start and at each step's end."""
    time_s = np.concatenate([[0.0], np.cumsum(steps.duration_s)])
    ends_s = time_s[1:][_lasts(steps, settings)]
    turn = np.interp(time_s, ends_s, np.unwrap(found.turn_rad))
    return turn, np.interp(time_s, ends_s, found.sd_rad)


def _each_sample(
    steps: FilterSteps, xyzw: FloatArray, sd_rad: FloatArray, bias_rad_s: FloatArray, disturbed: BoolArray
) -> Estimate:
    """Give every sample what was found for its step."""
    each = np.repeat(np.arange(len(steps.last)), np.diff(steps.last, prepend=0))
    return Estimate(xyzw, sd_rad[each], bias_rad_s[each], disturbed[each], steps.resting[each])
