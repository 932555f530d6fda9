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
from dataclasses import dataclass
from typing import Any

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.kernels.orientation import heading as kernel
from xsens.fusion.settings import FusionSettings

_FIRST, _BESIDE, _IRON = range(3)
"""The three filters."""

_ODDS = np.array([0.0, 3.0, 100.0])
"""Logarithms of the odds against each: one recording in twenty begins beside iron. Of BROAD's undisturbed
trials, six have less than 25 of evidence for iron that is not there, one 240; a magnet of a tenth of the
field has 170 in a minute of turning."""

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


@dataclass(frozen=True)
class Headings:
    """Angle about up from level axes to north, at the end of each bin.

    Attributes
    ----------
    turn_rad, sd_rad : ndarray, shape (n,)
    disturbed : ndarray of bool, shape (n,)
        Where the reading was hardly believed.
    stray : ndarray, shape (n,)
        How much the field changes from place to place: a fraction of its norm, per component.
    iron : ndarray, shape (n,)
        Weight of the filter that takes iron to be on the sensor, 0 to 1.
    """

    turn_rad: FloatArray
    sd_rad: FloatArray
    disturbed: BoolArray
    stray: FloatArray
    iron: FloatArray

    def __getitem__(self, which: IntArray) -> Headings:
        return Headings(*(values[which] for values in vars(self).values()))


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
        self._filters = _fresh(_STRAY)
        self._evidence, self._doubt = np.zeros(len(_ODDS)), np.zeros(len(_ODDS))
        self._norm = math.nan
        self._bias: FloatArray | None = None

    def resume(self) -> None:
        """Find north again after a pause; keep iron, lag and the evidence."""
        self._filters["begun"] = False
        self._bias = None

    def follow(self, bins: Any, bias_rad_s: FloatArray) -> Headings:
        """Take in bins; `bias_rad_s`, shape (n, 3), is the bias with which each one's steps ended."""
        bins = bins.copy()
        before = bias_rad_s[:1] if self._bias is None else self._bias[None]
        bins["bias_change"] = np.diff(bias_rad_s, axis=0, prepend=before)
        self._bias = bias_rad_s[-1].copy()
        found = self._run(self._scaled(bins, 1), self._filters)
        moving = ~bins["resting"][:, None]  # a sensor at rest repeats itself and proves nothing
        keep = np.where(moving, np.exp(-bins["span_s"][:, None] / _MEMORY_S), 1.0)
        evidence = found["evidence"] * moving
        for now, share in zip(evidence, keep, strict=True):
            now += share * self._evidence
            self._evidence = now
        doubt = self._doubt + np.cumsum(found["doubt"] * moving, axis=0)
        self._evidence, self._doubt = evidence[-1].copy(), doubt[-1]
        return _mean(found, _weights(evidence, doubt), bins)

    def smooth(self, bins: Any) -> Headings:
        """North over a whole stretch, smoothed backward; the stray at first is the recording's."""
        bins, moving = self._scaled(bins, len(bins)), ~bins["resting"]
        found, stray = self._run(bins, self._filters), _STRAY
        if moving.any():
            best = _weights(*_sums(found, moving)).argmax()
            stray = max(float(np.median(found["stray"][moving, best])), _STRAY)
        shapes = ((kernel.SIZE,), *3 * [(kernel.SIZE, kernel.SIZE)])
        kept = [np.zeros((len(_ODDS), len(bins), *shape)) for shape in shapes]
        found = self._run(bins, _fresh(stray), kept)
        weights = _weights(*_sums(found, moving))
        for j in np.flatnonzero(weights > _NEGLIGIBLE):
            found["turn_rad"][:, j], found["variance"][:, j] = _backward(bins, *(each[j] for each in kept))
        return _mean(found, np.tile(np.where(weights > _NEGLIGIBLE, weights, 0.0), (len(bins), 1)), bins)

    def _scaled(self, bins: Any, readings: int) -> Any:
        """Bins whose fields are fractions of the norm, which is that of the first readings."""
        if not math.isfinite(self._norm) and bins["seen"].any():
            first = bins["field"][bins["seen"]][:readings]
            self._norm = float(np.median(np.linalg.norm(first, axis=1)))
        if self._norm > 0.0:
            bins["field"] /= self._norm
            bins["field_rate"] /= self._norm
        return bins

    def _run(self, bins: Any, filters: Any, kept: list[FloatArray] | None = None) -> Any:
        """What each filter finds in each bin, shape (n, filters)."""
        found = np.zeros((len(_ODDS), len(bins)), kernel.HEADING)
        none = [np.zeros((0, kernel.SIZE)), *3 * [np.zeros((0, kernel.SIZE, kernel.SIZE))]]
        for j in range(len(_ODDS)):
            into = none if kept is None else [each[j] for each in kept]
            kernel.find_headings(bins, self._models[j : j + 1], filters[j : j + 1], found[j], *into)
        return found.T


def _fresh(stray: float) -> Any:
    """The filters before the first reading."""
    filters = np.zeros(len(_ODDS), kernel.FILTER)
    filters["stray"] = stray
    return filters


def _sums(found: Any, moving: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Evidence and doubt of each filter over a recording."""
    return found["evidence"].sum(axis=0), found["doubt"][moving].sum(axis=0)


def _weights(evidence: FloatArray, doubt: FloatArray) -> FloatArray:
    """Weights of the filters: iron on the sensor by its evidence over the better one of the other two."""
    against = np.tile(_ODDS, (*evidence.shape[:-1], 1))
    against[..., _IRON] -= evidence[..., _IRON] - evidence[..., :_IRON].max(axis=-1)
    against[..., :_IRON] += doubt[..., :_IRON]
    against[..., :_IRON] -= against[..., :_IRON].min(axis=-1, keepdims=True)
    likely = np.exp(against.min(axis=-1, keepdims=True) - against)
    return np.asarray(likely / likely.sum(axis=-1, keepdims=True))


def _mean(found: Any, weights: FloatArray, bins: Any) -> Headings:
    """The likeliest filter's angle, and deviation of all from it by their weights, shape (n, filters)."""
    best = np.take_along_axis(found["turn_rad"], weights.argmax(axis=1)[:, None], axis=1)
    off = np.angle(np.exp(1j * (found["turn_rad"] - best)))
    variance = (weights * (found["variance"] + off**2)).sum(axis=1)
    trust, stray = ((weights * found[name]).sum(axis=1) for name in ("trust", "stray"))
    disturbed = bins["seen"] & (trust < _DISTRUSTED)
    return Headings(best[:, 0], np.sqrt(variance), disturbed, stray, weights[:, _IRON])


def _backward(
    bins: Any, states: FloatArray, covariances: FloatArray, transitions: FloatArray, noises: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Angle and variance of one filter, smoothed; before the first reading, back by the gyroscope."""
    from filterpy.kalman import KalmanFilter

    first = int(np.argmax(covariances[:, 0, 0] > 0.0))
    smoother = KalmanFilter(dim_x=kernel.SIZE, dim_z=3)
    noises = noises + _ROUNDING * np.eye(kernel.SIZE)
    filtered = (each[first:] for each in (states, covariances, transitions, noises))
    means, spread, _, _ = smoother.rts_smoother(*filtered)
    found = np.array([kernel.turn_to_north(x, p) for x, p in zip(means, spread, strict=True)])
    # Before the first reading the level axes are the gyroscope's, whose errors add up.
    early = bins[1 : first + 1]
    moving_s = early["span_s"] * ~early["resting"]
    grown = np.cumsum((early["slip_rad2"] + moving_s**2 * early["bias_variance"])[::-1])[::-1]
    turn, variance = np.unwrap(found[:, 0]), found[:, 1]
    return np.pad(turn, (first, 0), mode="edge"), np.concatenate([variance[0] + grown, variance])
