"""Samples to orientation, inclination first, then heading: the filter as they come, and the smoother."""

from __future__ import annotations

from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.orientation.inclination import STEP
from xsens.fusion.heading import HeadingFilter, averaged_bins, lasts_of_bins, steps_per_bin
from xsens.fusion.inclination import CLAIMED, InclinationFilter, smooth, within_steps
from xsens.fusion.readings import Estimate, Samples
from xsens.fusion.settings import FusionSettings

_UNKNOWN = (0.0, np.pi, False, np.nan, np.nan)
"""Turn to north, its deviation, disturbed, stray and iron where no field has told the heading."""


class Filter:
    """The filter over samples as they come; bias, iron and lag are kept over a pause."""

    def __init__(self, settings: FusionSettings) -> None:
        self._settings = settings
        self._level, self._heading = InclinationFilter(settings), HeadingFilter(settings)
        self.begin(0.0)

    def begin(self, pause_s: float) -> None:
        """Find up and north again with the next sample, so long after the one before."""
        self._level.begin(pause_s)
        self._heading.resume()
        self._rows = np.zeros(0, STEP)  # steps of a bin that is not whole
        self._steps = np.zeros(0, STEP)  # the last one
        self._north = np.zeros((0, len(_UNKNOWN)))  # at the end of the last bin

    def run(self, samples: Samples, to_end: bool = False) -> Estimate:
        """Orientation at every sample by the samples so far.

        What is claimed is of the last whole increment, and of the heading of the last whole bin; before the
        first of them, in the same samples, of that one.

        Parameters
        ----------
        samples : Samples
            Without a pause.
        to_end : bool
            They are the last ones before a pause or the end.
        """
        settings, per_bin, before = self._settings, steps_per_bin(self._settings), len(self._rows)
        steps = self._level.run(samples, to_end)
        rows = np.concatenate([self._rows, steps.rows])
        whole = len(rows) if to_end else len(rows) // per_bin * per_bin
        self._rows, north = rows[whole:], self._north
        if settings.use_magnetometer and whole:
            rows = rows[:whole]
            bins = averaged_bins(rows, rows["start"], rows["bias"], rows["sd"], settings)
            north = np.concatenate([north, self._heading.follow(bins)])
        done = np.searchsorted(steps.last, np.arange(1, len(samples) + 1), side="right")
        of_bin = (before + done) // per_bin + len(self._north) - 1
        known = np.concatenate([self._steps, steps.rows])
        of_step = np.maximum(done + len(self._steps) - 1, 0)
        self._steps, self._north = known[-1:], north[-1:]
        north = north if len(north) else np.array([_UNKNOWN])
        turn, heading_sd, disturbed, stray, iron = north[np.clip(of_bin, 0, len(north) - 1)].T
        known = known if len(known) else np.zeros(1, STEP)
        sd = known["sd"][of_step, :3] * CLAIMED
        if settings.use_magnetometer:
            sd[:, 2] = heading_sd
        return Estimate(
            turned(turn, steps.xyzw),
            sd,
            known["bias"][of_step],
            disturbed > 0.0,
            known["resting"][of_step],
            stray,
            iron,
        )

    @property
    def last(self) -> Any:
        """The last whole increment; empty before the first."""
        return self._steps


def smoothed(samples: Samples, settings: FusionSettings) -> Estimate:
    """Orientation of a stretch by all its samples; it must be longer than a second."""
    steps, nodes, biases, deviations = smooth(samples, settings)
    rows, sd, count = steps.rows, deviations[:, :3].copy(), len(steps.rows)
    north = np.tile(_UNKNOWN, (count, 1))
    if settings.use_magnetometer and np.isfinite(rows["field"][:, 0]).any():
        bins = averaged_bins(rows, nodes[:-1], biases[1:], deviations[1:], settings)
        of_bins = HeadingFilter(settings, online=False).smooth(bins)
        time_s = np.append(0.0, np.cumsum(rows["duration_s"]))
        ends_s = time_s[1:][lasts_of_bins(count, settings)]
        nodes = turned(np.interp(time_s, ends_s, np.unwrap(of_bins[:, 0])), nodes)
        sd[:, 2] = np.interp(time_s, ends_s, of_bins[:, 1])
        north = of_bins[np.arange(count) // steps_per_bin(settings)]
    elif settings.use_magnetometer:
        sd[:, 2] = np.pi
    xyzw = within_steps(samples, steps, nodes, biases)
    of_step = np.repeat(np.arange(count), np.diff(steps.last, prepend=0))
    _, _, disturbed, stray, iron = north[of_step].T
    resting = rows["resting"][of_step]
    return Estimate(xyzw, sd[1:][of_step], biases[1:][of_step], disturbed > 0.0, resting, stray, iron)


def turned(angles_rad: FloatArray | float, xyzw: FloatArray) -> FloatArray:
    """Quaternions, shape (k, 4), turned about up."""
    c, s = np.cos(0.5 * angles_rad), np.sin(0.5 * angles_rad)
    x, y, z, w = xyzw.T
    return np.column_stack([c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z])
