"""Orientation of a stretch without a pause: inclination, then heading, at every sample."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from xsens.fusion.bins import averaged_bins, filtered_bins, lasts_of_bins, steps_per_bin
from xsens.fusion.heading import HeadingFilter, Headings
from xsens.fusion.inclination import FilterSteps, forward, fresh_filter, smooth, within_steps
from xsens.fusion.samples import Estimate, Samples
from xsens.fusion.settings import FusionSettings

_Field: TypeAlias = tuple[BoolArray, FloatArray, FloatArray]
"""Where it was hardly believed, how much it strays, and the weight of iron on the sensor; a row a step."""


class StretchFilter:
    """The filter over one stretch after another; bias, iron and lag are kept from each to the next."""

    def __init__(self, settings: FusionSettings) -> None:
        self._settings = settings
        self._level = fresh_filter(settings)
        self._heading = HeadingFilter(settings)

    def run(self, samples: Samples, pause_s: float) -> Estimate:
        """Orientation of the next stretch, `pause_s` after the last, by the readings so far."""
        settings = self._settings
        magnetic = settings.use_magnetometer
        steps = forward(samples, settings, self._level, pause_s, heading_apart=magnetic)
        starts, sd = steps.start, steps.claimed_sd_rad
        field = _no_field(len(starts))
        if magnetic:
            self._heading.resume()
            found = self._heading.follow(filtered_bins(steps, settings), _ends(steps, settings))
            # A step turns by the heading of the last whole bin; those of the first bin by its own.
            known = np.maximum(_bin_of(steps, settings) - 1, 0)
            starts = _turned(found.turn_rad[known], starts)
            sd = np.column_stack([sd[:, :2], found.sd_rad[known]])
            field = _field_of(found, known)
        xyzw = within_steps(steps, starts, steps.start_bias_rad_s)
        return _each_sample(steps, xyzw, sd, steps.bias_rad_s, field)


def smoothed(samples: Samples, settings: FusionSettings) -> Estimate:
    """Orientation of a stretch by all its readings; it must be longer than a second."""
    steps, level = smooth(samples, settings)
    nodes, sd = level.matrices, level.sd_rad
    field = _no_field(len(steps.last))
    if settings.use_magnetometer and np.isfinite(steps.field_au[:, 0]).any():
        bias, bias_sd = level.bias_rad_s[1:], level.bias_sd_rad_s[1:]
        bins = averaged_bins(steps, nodes[:-1], bias, bias_sd, sd[1:], settings)
        found = HeadingFilter(settings, online=False).smooth(bins)
        turn, heading_sd = _at_nodes(steps, found, settings)
        nodes = _turned(turn, nodes)
        sd = np.column_stack([sd[:, :2], heading_sd])
        field = _field_of(found, _bin_of(steps, settings))
    elif settings.use_magnetometer:
        sd = np.column_stack([sd[:, :2], np.full(len(sd), np.pi)])
    xyzw = within_steps(steps, nodes[:-1], level.bias_rad_s[:-1], nodes[1:])
    return _each_sample(steps, xyzw, sd[1:], level.bias_rad_s[1:], field)


def _ends(steps: FilterSteps, settings: FusionSettings) -> FloatArray:
    """Bias at the end of each bin."""
    return steps.bias_rad_s[lasts_of_bins(steps, settings)]


def _no_field(count: int) -> _Field:
    """Of steps whose heading no field tells."""
    return np.zeros(count, dtype=bool), np.full(count, np.nan), np.full(count, np.nan)


def _field_of(found: Headings, bins: IntArray) -> _Field:
    """What the bins of some steps tell of the field."""
    return found.disturbed[bins], found.stray[bins], found.iron[bins]


def _turned(angles_rad: FloatArray, matrices: FloatArray) -> FloatArray:
    """Rotations, shape (k, 3, 3), turned about up."""
    turns = Rotation.from_euler("z", angles_rad[:, None]).as_matrix()
    return np.asarray(turns @ matrices)


def _bin_of(steps: FilterSteps, settings: FusionSettings) -> IntArray:
    """Bin of each step."""
    return np.asarray(np.arange(len(steps.last)) // steps_per_bin(settings))


def _at_nodes(steps: FilterSteps, found: Headings, settings: FusionSettings) -> tuple[FloatArray, FloatArray]:
    """Angle to north and its deviation at the start and at each step's end."""
    time_s = np.concatenate([[0.0], np.cumsum(steps.duration_s)])
    ends_s = time_s[1:][lasts_of_bins(steps, settings)]
    turn = np.interp(time_s, ends_s, np.unwrap(found.turn_rad))
    return turn, np.interp(time_s, ends_s, found.sd_rad)


def _each_sample(
    steps: FilterSteps, xyzw: FloatArray, sd_rad: FloatArray, bias_rad_s: FloatArray, field: _Field
) -> Estimate:
    """Give every sample what was found for its step."""
    each = np.repeat(np.arange(len(steps.last)), np.diff(steps.last, prepend=0))
    disturbed, stray, iron = field
    found = (xyzw, sd_rad[each], bias_rad_s[each], disturbed[each], steps.resting[each])
    return Estimate(*found, stray[each], iron[each])
