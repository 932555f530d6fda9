"""Turn level axes, carried by the gyroscope, to magnetic north: Kalman filters of the field.

The field that a moving sensor reads is the room's, plus what the place adds (another one for each stay at
rest and for the movement between), plus a stray that changes as it moves on, plus the field of iron on the
sensor, all as vectors. Norm and dip, which tell nothing of the heading, tell how large the stray is here: it
is followed as the readings come, so that a quiet room's field is followed closely and a poor one's hardly.

There are three filters: north is the field's where the sensor was at first; the first place was beside
iron; iron is on the sensor. A resting sensor cannot tell the first two apart: the field is the same. When it
changes against the gyroscope, either the earlier field was the wrong one or the later one is. So their odds
are by how long each field lasted in movement, not by how well it fits, and sigma covers both headings. Iron
on the sensor must prove itself: one that is turned while it is carried through an uneven field shows nearly
the same.

Two properties of the sensor are found on the way: the lag of its magnetometer (its readings are older than
the gyroscope's), and the gyroscope's bias in movement, which is not quite that at rest.

References
----------
.. [1] R. K. Mehra, "Approaches to adaptive filtering", IEEE TAC 17, 1972 (the stray's variance).
.. [2] M. Roth, E. Ozkan, F. Gustafsson, "A Student's t filter for heavy tailed process and measurement
   noise", ICASSP 2013 (readings off the model).
.. [3] H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems",
   AIAA J., 1965 (the smoother).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.kernels.orientation import heading as kernel
from xsens.fusion.settings import FusionSettings

_FIRST, _BESIDE, _IRON = range(3)
"""The three filters."""

_ODDS = np.array([0.0, 3.0, 100.0])
"""Logarithms of the odds against each: one recording in twenty begins beside iron. Of BROAD's undisturbed
trials, six have less than 25 of evidence for iron that is not there, one 240; a magnet of a tenth of the
field has 170 in a minute of turning."""

_ALIKE = 18.0
"""Bins that tell as much of iron as one: an uneven field lasts some seconds of movement. So what is claimed
covers both headings until the evidence is plain. Simulated iron of 30 uT: errors of 4.5 claims become 2.5."""

_STRAY = 0.01
"""At first: of the norm, per component; a room without iron near."""

_MEMORY_S = 300.0
"""Time over which evidence is weighed while samples arrive; a recording is weighed as a whole."""

_FIRST_STRAY = 0.25
"""The first reading's stray while samples arrive, as a fraction: the first readings are all there is, and a
rough room would swing the heading about. A recording tells it in full."""

_DISTRUSTED = 0.5

_ROUNDING = 1e-12
"""Variance that keeps covariances invertible: (1 microradian)^2, a millionth of the field, 1 microsecond."""

_NEGLIGIBLE = 0.005
"""Filters of less weight are not smoothed."""


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
    structured ndarray, shape (bins,), of `kernel.BIN`
    """
    lasts = lasts_of_bins(len(rows), settings)
    firsts, counts = np.append(0, lasts[:-1] + 1), np.diff(lasts, prepend=-1)
    bins = np.zeros(len(lasts), kernel.BIN)
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


NORTH = ("turn_rad", "sd_rad", "disturbed", "stray", "iron")
"""What is told at the end of a bin: the angle about up from level axes to north; its deviation; whether the
reading was hardly believed; how much the field changes from place to place, a fraction of its norm, per
component; the weight of the filter that takes iron to be on the sensor, 0 to 1."""


class HeadingFilter:
    """The three filters, bin by bin; `online` if the readings so far are all there is."""

    def __init__(self, settings: FusionSettings, online: bool = True) -> None:
        self._models = np.zeros(len(_ODDS), kernel.MODEL)
        self._models["iron"] = 0.002  # what a calibration leaves
        self._models["iron"][_IRON], self._models["iron_put_on"][_IRON] = 0.7, 0.15
        self._models["first_place"], self._models["first_place"][_BESIDE] = settings.field_first_place, 0.3
        self._models["beside_iron"][_BESIDE] = True
        self._models["place"] = settings.field_place
        self._models["white_sqrt_s"] = settings.field_noise_sqrt_s
        self._models["lag_s"] = settings.magnetometer_lag_s
        self._models["first_stray"] = _FIRST_STRAY if online else 1.0
        self._models["memory_s"] = _MEMORY_S if online else math.inf
        self._begin(_STRAY)

    def _begin(self, stray: float) -> None:
        self._filters = np.zeros(len(_ODDS), kernel.FILTER)
        self._filters["stray"] = stray

    def resume(self) -> None:
        """Find north again after a pause; keep iron, lag and the evidence."""
        self._filters["begun"] = False

    def follow(self, bins: Any) -> FloatArray:
        """Take in bins; returns `NORTH` of each."""
        rows = self._run(bins)
        return _mean(rows, _weights(rows), bins)

    def smooth(self, bins: Any) -> FloatArray:
        """North over a whole stretch, smoothed backward; the stray at first is the recording's."""
        bins["bias"] = 0.0  # with a smoothed bias, there is no better one to come
        rows, moving = self._run(bins), ~bins["resting"]
        best = _weights(rows[-1]).argmax()
        self._begin(max(float(np.median(rows["stray"][moving, best])) if moving.any() else 0.0, _STRAY))
        filtered = _shaped(len(_ODDS), len(bins))
        rows = self._run(bins, filtered)
        weights = _weights(rows[-1])
        weights[weights < _NEGLIGIBLE] = 0.0
        for j in np.flatnonzero(weights):
            rows["turn_rad"][:, j], rows["variance"][:, j] = _backward(*(each[j] for each in filtered))
        return _mean(rows, np.tile(weights, (len(bins), 1)), bins)

    def _run(self, bins: Any, filtered: list[FloatArray] | None = None) -> Any:
        """What each filter finds in each bin, shape (n, filters)."""
        rows = np.zeros((len(bins), len(_ODDS)), kernel.HEADING)
        kernel.find_headings(bins, self._models, self._filters, rows, *(filtered or _shaped(0, 0)))
        return rows


def _shaped(*shape: int) -> list[FloatArray]:
    """Arrays for states, covariances, transitions and noises."""
    size = kernel.SIZE
    return [np.zeros((*shape, *each)) for each in ((size,), *3 * [(size, size)])]


def _weights(rows: Any) -> FloatArray:
    """Weights of the filters: iron on the sensor by its evidence over the better one of the other two."""
    evidence, against = rows["evidence"], np.tile(_ODDS, (*rows.shape[:-1], 1))
    against[..., _IRON] -= evidence[..., _IRON] - evidence[..., :_IRON].max(axis=-1)
    against[..., :_IRON] += rows["doubt"][..., :_IRON]
    against[..., :_IRON] -= against[..., :_IRON].min(axis=-1, keepdims=True)
    against[..., _IRON] /= _ALIKE
    likely = np.exp(against.min(axis=-1, keepdims=True) - against)
    return np.asarray(likely / likely.sum(axis=-1, keepdims=True))


def _mean(rows: Any, weights: FloatArray, bins: Any) -> FloatArray:
    """The likeliest filter's angle, and deviation of all from it by their weights, shape (n, filters)."""
    best = np.take_along_axis(rows["turn_rad"], weights.argmax(axis=1)[:, None], axis=1)
    off = np.angle(np.exp(1j * (rows["turn_rad"] - best)))
    variance = (weights * (rows["variance"] + off**2)).sum(axis=1)
    trust, stray = ((weights * rows[name]).sum(axis=1) for name in ("trust", "stray"))
    disturbed = bins["seen"] & (trust < _DISTRUSTED)
    return np.column_stack([best, np.sqrt(variance), disturbed, stray, weights[:, _IRON]])


def _backward(
    states: FloatArray, covariances: FloatArray, transitions: FloatArray, noises: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Angle and variance of one filter, smoothed; before the first reading as there."""
    from filterpy.kalman import KalmanFilter

    first = int(np.argmax(covariances[:, 0, 0] > 0.0))
    smoother = KalmanFilter(dim_x=kernel.SIZE, dim_z=3)
    filtered = (states, covariances, transitions, noises + _ROUNDING * np.eye(kernel.SIZE))
    means, spread, _, _ = smoother.rts_smoother(*(each[first:] for each in filtered))
    turns = np.array([kernel.turn_to_north(x, p) for x, p in zip(means, spread, strict=True)])
    turn, variance = np.pad(turns, ((first, 0), (0, 0)), mode="edge").T
    return np.unwrap(turn), variance
