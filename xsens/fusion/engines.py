"""Samples to orientation: the filter as they come and the smoother, inclination first, then heading; and VQF.

Inclination has no part of the magnetometer, so iron cannot tilt the orientation; `heading` turns it to north.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.kernels.orientation import inclination as kernel
from speckle3d.kernels.orientation.smoothing import orient_samples, rotate_rows, smooth_steps, turn_about_up
from xsens.fusion.heading import STEPS_PER_BIN, UNKNOWN, HeadingFilter, averaged_bins
from xsens.fusion.readings import BIAS_SD_RAD_S, Estimate, Samples
from xsens.logs.samples import median

BLOCK_S = kernel.BLOCK_S
"""Length of the filter's increments."""

_CLAIMED_SHARES = np.array([0.6, 0.6, 1.0])
"""Of the filter's deviation of inclination, what is claimed. The hand's velocity, an error that persists, is
taken for white noise as strong at low frequencies: so it is for the smoother, but the filter sees less of it.
Measured on twelve trials of BROAD (Laidig et al. 2021)."""


_SCALE_NOISE_SQRT_S, _SWING_SQRT_S = 0.003, np.sqrt(2.0 * 0.25)
"""Error of the gyroscope's scale and axes, a fraction of the turn, at least: 0.4 % times the latter, of a
swing of about 0.25 s over which it persists."""


class Filter:
    """The filter over samples as they come; bias, iron and lag are kept over a pause.

    Parameters
    ----------
    magnetic : bool
        Let the field tell the heading; without it the heading starts at zero.
    scale_error : float
        Share of its turns by which the gyroscope is off.
    bias_sd_rad_s : float
        Standard deviation of the gyroscope's bias at switching on.
    """

    def __init__(
        self, magnetic: bool = True, scale_error: float = 0.0, bias_sd_rad_s: float = BIAS_SD_RAD_S
    ) -> None:
        self.magnetic, self._heading = magnetic, HeadingFilter()
        self._filter, self._unfinished = np.zeros(1, kernel.FILTER), np.zeros(1, kernel.STEP)
        speed_m_s = 2.0 * kernel.SPEED_M_S
        tilt = speed_m_s / kernel.GRAVITY_M_S2  # of the mean force over a second
        self._filter["fresh"] = np.square([tilt, tilt, 1e-6, *3 * [bias_sd_rad_s], *3 * [speed_m_s]])
        self._filter["scale_noise_sqrt_s"] = max(_SCALE_NOISE_SQRT_S, _SWING_SQRT_S * scale_error)
        self.begin(0.0)

    def begin(self, pause_s: float) -> None:
        """Find up and north again with the next sample, so long after the one before."""
        self._filter["pause_s"] = pause_s
        self._heading.resume()
        self.last = np.zeros(0, kernel.STEP)  # whole increment

    @property
    def start_force_m_s2(self) -> Any:
        """Mean accelerometer's reading by which up was found, shape (1, 3)."""
        return self._filter["start_force"] / self._filter["start_s"][:, None]

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
        most = min(m, int(2.0 * samples.step_s.sum() / BLOCK_S) + 2)
        rows, xyzw = np.zeros(most, kernel.STEP), np.empty((m, 4))
        covariance, transition = np.empty((2, most if covariances else 0, kernel.SIZE, kernel.SIZE))
        readings = map(np.ascontiguousarray, vars(samples).values())
        run: Any = kernel.run_filter
        n = run(*readings, to_end, self._filter, self._unfinished, rows, covariance, transition, xyzw)
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
        rows["north"] = self._heading.follow(rows, to_end) if self.magnetic else UNKNOWN
        step_of_sample = np.searchsorted(rows["last"], np.arange(1, len(samples) + 1), side="right")
        step_of_sample = np.maximum(step_of_sample + len(self.last) - 1, 0)
        steps = np.concatenate([self.last, rows]) if len(self.last) else rows
        self.last = steps[-1:].copy()
        if not len(steps):
            steps = np.zeros(1, kernel.STEP)
            steps["north"] = UNKNOWN
        sd = steps["sd"][:, :3] * _CLAIMED_SHARES
        if self.magnetic:
            sd[:, 2] = steps["north"][:, 1]
        xyzw = turn_about_up(steps["north"][step_of_sample, 0], xyzw)
        return _at_samples(samples, xyzw, sd, steps, step_of_sample)


def smooth(samples: Samples, fresh: Filter) -> Estimate:
    """Orientation of a stretch by all its samples; it must be longer than the filter's start, a second."""
    rows, _, covariance, transition = fresh.steps(samples, to_end=True, covariances=True)
    n, first = len(rows), int(np.argmax(rows["started"]))
    nodes, biases = np.empty((n + 1, 4)), np.empty((n + 1, 3))  # at the start, and the end of each step
    smooth_steps(rows, covariance, transition, first, nodes, biases)
    variance = np.diagonal(covariance, axis1=1, axis2=2)[np.maximum(np.arange(n), first), :6]
    rows["sd"] = np.sqrt(np.maximum(variance, 0.0))
    rows["start"], rows["bias"] = nodes[:-1], biases[1:]
    sd, rows["north"] = rows["sd"][:, :3].copy(), UNKNOWN
    if fresh.magnetic:
        bins = averaged_bins(rows)
        if bins["seen"].any():
            of_bins = HeadingFilter(online=False).smooth(bins)
            ends_s, time_s = np.cumsum(bins["span_s"]), np.append(0.0, np.cumsum(rows["duration_s"]))
            nodes = turn_about_up(np.interp(time_s, ends_s, np.unwrap(of_bins[:, 0])), nodes)
            rows["north"] = of_bins[np.arange(n) // STEPS_PER_BIN]
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
    bias_rad_s = steps["bias"].take(of_sample, axis=0)
    late_rad = 0.5 * median(samples.step_s) * rotate_rows(xyzw, samples.rate_rad_s - bias_rad_s)
    distrust, stray, iron = steps["north"][:, 2:].T.take(of_sample, axis=1)
    sd_rad = np.sqrt(np.square(sd_rad).take(of_sample, axis=0) + late_rad**2)
    return Estimate(xyzw, sd_rad, bias_rad_s, distrust > 0.0, steps["resting"][of_sample], stray, iron)


def by_vqf(stretch: Samples, claims: Estimate, offline: bool, magnetic: bool) -> Estimate:
    """Orientation of a stretch by VQF [1]_, which wants an even clock and a field at every sample.

    Parameters
    ----------
    stretch : Samples
    claims : Estimate
        The same by this package's engine: its variances, plus the squared distance of VQF from it about each
        of the world's axes, are VQF's variances.
    offline : bool
        Use later readings as well.
    magnetic : bool
        Let the magnetic field tell the heading.

    Raises
    ------
    InvalidInputError
        If VQF is not installed.

    References
    ----------
    .. [1] D. Laidig, T. Seel, Information Fusion 91, 2023.
    """
    try:
        import vqf
    except ImportError as error:
        raise InvalidInputError(
            "the methods vqf and vqf-online need the package vqf, got none installed: pip install vqf, "
            "which may need a C++ compiler, or choose smoother or filter"
        ) from error
    magnetic = magnetic and bool(np.isfinite(stretch.field_au[:, 0]).any())
    time_s = np.cumsum(stretch.step_s)
    step_s = stretch.step_s.mean()
    place = (time_s - time_s[0]) / step_s
    grid = np.arange(max(round(place[-1]), 1) + 1.0)
    # A gyroscope's reading is the mean rate since the one before, here too: turns stay what they were.
    angle = np.cumsum(stretch.rate_rad_s * np.diff(place, prepend=-1.0)[:, None], axis=0)
    rate = np.diff(_at(grid, place, angle), axis=0, prepend=0.0)
    force = _at(grid, place, stretch.force_m_s2)
    field = _at(grid, place, stretch.field_au) if magnetic else None
    readings = rate, force, field
    estimate = vqf.offlineVQF(*readings, step_s) if offline else vqf.VQF(step_s).updateBatch(*readings)
    rotations = Rotation.from_quat(estimate["quat9D" if magnetic else "quat6D"], scalar_first=True)
    xyzw = Slerp(grid, rotations)(np.minimum(place, grid[-1])).as_quat()
    if magnetic:  # from VQF's world, x east; without a field both engines begin by the shortest turn to up
        xyzw = turn_about_up(np.full(len(xyzw), -0.5 * np.pi), xyzw)
    difference = Rotation.from_quat(xyzw) * Rotation.from_quat(claims.xyzw).inv()
    at = np.minimum(np.rint(place).astype(np.int64), len(grid) - 1)
    disturbance = estimate["magDistDetected"][at] if magnetic else np.zeros(len(stretch), dtype=bool)
    return replace(
        claims,
        xyzw=xyzw,
        standard_deviation_rad=np.minimum(
            np.hypot(claims.standard_deviation_rad, difference.as_rotvec()), np.pi
        ),
        gyro_bias_rad_s=estimate["bias"][at],
        disturbed=disturbance,
        resting=estimate["restDetected"][at],
    )


def _at(places: FloatArray, grid: FloatArray, values: FloatArray) -> FloatArray:
    """Finite rows interpolated at places, from those at known ones."""
    rows = np.isfinite(values[:, 0])
    return np.column_stack([np.interp(places, grid[rows], column[rows]) for column in values.T])
