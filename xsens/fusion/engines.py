"""Samples to orientation, inclination first, then heading: the filter as they come, and the smoother.

Inclination has no part of the magnetometer, so iron cannot tilt the orientation; `heading` turns it to north.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.kernels.orientation import inclination as kernel
from speckle3d.kernels.orientation.smoothing import orient_samples, smooth_steps
from xsens.fusion.heading import UNKNOWN, HeadingFilter, averaged_bins, steps_per_bin
from xsens.fusion.readings import Estimate, Samples, turn_about_up
from xsens.fusion.settings import FusionSettings

_CLAIMED_SHARES = np.array([0.6, 0.6, 1.0])
"""Of the filter's deviation of inclination, what is claimed. The hand's velocity, an error that persists, is
taken for white noise as strong at low frequencies: so it is for the smoother, but the filter sees less of it.
Measured on twelve trials of BROAD (Laidig et al. 2021)."""


class Filter:
    """The filter over samples as they come; bias, iron and lag are kept over a pause."""

    def __init__(self, settings: FusionSettings) -> None:
        self._settings, self._heading = settings, HeadingFilter(settings)
        self._filter, self._unfinished = np.zeros(1, kernel.FILTER), np.zeros(1, kernel.STEP)
        tilt = 2.0 * settings.speed_m_s / settings.gravity_m_s2  # of the mean force over a second
        deviations = [tilt, tilt, 1e-6, *3 * [settings.bias_sd_rad_s], *3 * [2.0 * settings.speed_m_s]]
        self._filter["fresh"] = np.square(deviations)
        numbers = vars(settings)
        self._limits = np.array([tuple(numbers.values())], [(name, "f8") for name in numbers])
        self.begin(0.0)

    def begin(self, pause_s: float) -> None:
        """Find up and north again with the next sample, so long after the one before."""
        self._filter["pause_s"] = pause_s
        self._heading.resume()
        self.last = np.zeros(0, kernel.STEP)  # whole increment

    @property
    def start_force_m_s2(self) -> FloatArray:
        """Mean accelerometer's reading by which up was found, shape (1, 3)."""
        return np.asarray(self._filter["start_force"] / self._filter["start_s"][:, None])

    def steps(
        self, samples: Samples, to_end: bool, covariances: bool = False
    ) -> tuple[Any, FloatArray, FloatArray, FloatArray]:
        """Increments that samples without a pause complete.

        Returns
        -------
        structured ndarray, shape (n,), of `kernel.STEP`
        ndarray, shape (m, 4)
            Level axes from the sensor's at every sample, by what came before it.
        ndarray, shape (n, 9, 9), or (0, 9, 9) unless they are wanted
            Covariances, and transitions.
        """
        m = len(samples)
        most = min(m, int(2.0 * samples.step_s.sum() / self._settings.block_s) + 2)
        rows, xyzw = np.zeros(most, kernel.STEP), np.empty((m, 4))
        covariance, transition = np.empty((2, most if covariances else 0, kernel.SIZE, kernel.SIZE))
        arguments: list[Any] = [np.ascontiguousarray(values) for values in vars(samples).values()]
        arguments += [to_end, self._filter, self._limits, self._unfinished]
        run: Any = kernel.run_filter
        n = run(*arguments, rows, covariance, transition, xyzw)
        return rows[:n], xyzw, covariance[:n], transition[:n]

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
        rows, xyzw, _, _ = self.steps(samples, to_end)
        rows["north"] = self._heading.follow(rows, to_end) if self._settings.use_magnetometer else UNKNOWN
        step_of_sample = np.searchsorted(rows["last"], np.arange(1, len(samples) + 1), side="right")
        step_of_sample = np.maximum(step_of_sample + len(self.last) - 1, 0)
        steps = np.concatenate([self.last, rows])
        self.last = steps[-1:]
        if not len(steps):
            steps = np.zeros(1, kernel.STEP)
            steps["north"] = UNKNOWN
        sd = steps["sd"][:, :3] * _CLAIMED_SHARES
        if self._settings.use_magnetometer:
            sd[:, 2] = steps["north"][:, 1]
        xyzw = turn_about_up(steps["north"][step_of_sample, 0], xyzw)
        return _at_samples(samples, xyzw, sd, steps, step_of_sample)


def smooth(samples: Samples, settings: FusionSettings) -> Estimate:
    """Orientation of a stretch by all its samples; it must be longer than the filter's start, a second."""
    rows, _, covariance, transition = Filter(settings).steps(samples, to_end=True, covariances=True)
    n, first = len(rows), int(np.argmax(rows["started"]))
    nodes, biases = np.empty((n + 1, 4)), np.empty((n + 1, 3))  # at the start, and the end of each step
    smooth_steps(rows, covariance, transition, first, nodes, biases)
    variance = np.diagonal(covariance, axis1=1, axis2=2)[np.maximum(np.arange(n), first), :6]
    rows["sd"] = np.sqrt(np.maximum(variance, 0.0))
    rows["start"], rows["bias"] = nodes[:-1], biases[1:]
    sd, rows["north"] = rows["sd"][:, :3].copy(), UNKNOWN
    if settings.use_magnetometer:
        bins = averaged_bins(rows, settings)
        if bins["seen"].any():
            of_bins = HeadingFilter(settings, online=False).smooth(bins)
            ends_s, time_s = np.cumsum(bins["span_s"]), np.append(0.0, np.cumsum(rows["duration_s"]))
            nodes = turn_about_up(np.interp(time_s, ends_s, np.unwrap(of_bins[:, 0])), nodes)
            rows["north"] = of_bins[np.arange(n) // steps_per_bin(settings)]
            rows["north"][:, 1] = np.interp(time_s[1:], ends_s, of_bins[:, 1])
        sd[:, 2] = rows["north"][:, 1]
    xyzw, rates = np.empty((len(samples), 4)), np.ascontiguousarray(samples.rate_rad_s)
    orient_samples(samples.step_s, rates, rows, nodes, biases, xyzw)
    of_step = np.repeat(np.arange(n), np.diff(rows["last"], prepend=0))
    return _at_samples(samples, xyzw, sd, rows, of_step)


def _at_samples(
    samples: Samples, xyzw: FloatArray, sd_rad: FloatArray, steps: Any, of_sample: IntArray
) -> Estimate:
    """Estimate of each sample by the step that it belongs to.

    When in its interval a gyroscope's reading is taken is not known: half of it is claimed as well.
    """
    bias_rad_s = steps["bias"][of_sample]
    rates = Rotation.from_quat(xyzw).apply(samples.rate_rad_s - bias_rad_s)
    late_rad = 0.5 * float(np.median(samples.step_s)) * rates
    _, _, distrust, stray, iron = steps["north"][of_sample].T
    sd_rad = np.sqrt(np.square(sd_rad)[of_sample] + late_rad**2)
    return Estimate(xyzw, sd_rad, bias_rad_s, distrust > 0.0, steps["resting"][of_sample], stray, iron)
