"""Turn level axes, carried by the gyroscope, to magnetic north: Kalman filters of the field.

The field that a moving sensor reads is the room's, plus what the place adds (another one for each stay at
rest and for the movement between), plus a stray that changes as it moves on, plus the field of iron on the
sensor, all as vectors. Norm and dip, which tell nothing of the heading, tell how large the stray is here: it
is followed as the readings come, so that a quiet room's field is followed closely and a poor one's hardly.
There are three filters: without iron on the sensor, with iron put on it later, and with iron on it from the
start. Iron must prove itself: a sensor that is turned while it is carried through an uneven field shows
nearly the same. Each filter's evidence is its weight in the mean.

Two properties of the sensor are found on the way: the lag of its magnetometer (its readings are older than
the gyroscope's), and the gyroscope's bias in movement, which is not quite that at rest. North is the field's
where the sensor was at first.

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
from typing import Any, NamedTuple

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.kernels.orientation import heading as kernel
from xsens.fusion.settings import FusionSettings


class _Iron(NamedTuple):
    """Iron on the sensor: deviations of its field at the start and of iron put on later, as fractions.

    `handicap` is the logarithm of the evidence that the filter without iron must lack.
    """

    at_start: float
    put_on: float = 0.0
    handicap: float = 0.0


_IRON = (_Iron(0.002), _Iron(0.02, 0.15, 100.0), _Iron(0.7, 0.15, 100.0))
"""None but what a calibration leaves; put on later; from the start. Of BROAD's undisturbed trials, six have
less than 25 of evidence for iron that is not there, one 240; a magnet of a tenth of the field has 170 in a
minute of turning."""

_MEMORY_S = 300.0
"""Time over which evidence is weighed while samples arrive; a recording is weighed as a whole."""

_ROOM = {
    "stray": 0.01,  # at first: of the norm, per component; a room without iron near
    "least_stray": 0.005,
    "most_stray": 0.3,
    "stray_s": 2.0,  # how long it persists: a hand's length at a hand's speed
    "adapts_s": 60.0,  # how fast its variance is followed
    "bias_s": 10.0,  # how long what is left of the gyroscope's bias persists
    "walk_sqrt_s": 0.0003,  # the room's random walk: 1 % in twenty minutes
    "freedom": 3.0,  # of Student's distribution of the readings' errors
    "outlier": 25.0,  # squared misfit that shows iron put on or off: one in 10^5 with normal errors
    "hold_s": 3.0,  # how long putting it on takes
}

_FIRST_STRAY = 0.25
"""The first reading's stray while samples arrive, as a fraction: the first readings are all there is, and a
rough room would swing the heading about. A recording tells it in full."""

_DISTRUSTED = 0.5
_ROUNDING = 1e-12
"""Variance that keeps covariances invertible: (1 microradian)^2, a millionth of the field, 1 microsecond."""

_NEGLIGIBLE = 5.0
"""Filters whose evidence is less by this, in logarithms, are not smoothed: their weight is below 1 %."""


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
        Weight of the filters that take iron to be on the sensor, 0 to 1.
    """

    turn_rad: FloatArray
    sd_rad: FloatArray
    disturbed: BoolArray
    stray: FloatArray
    iron: FloatArray


class HeadingFilter:
    """The three filters, bin by bin; `online` if the readings so far are all there is."""

    def __init__(self, settings: FusionSettings, online: bool = True) -> None:
        shared = _ROOM | {
            "place": settings.field_place,
            "first_place": settings.field_first_place,
            "white_sqrt_s": settings.field_noise_sqrt_s,
            "lag_s": settings.magnetometer_lag_s,
            "first_stray": _FIRST_STRAY if online else 1.0,
        }
        self._room = np.array([tuple(shared[name] for name in kernel.ROOMS.names or ())], kernel.ROOMS)
        self._kept = np.zeros(len(_IRON), kernel.KEPT)
        self._kept["iron"] = [iron.at_start for iron in _IRON]
        self._kept["iron_put_on"] = [iron.put_on for iron in _IRON]
        self._handicap = np.array([iron.handicap for iron in _IRON])
        self._scores = np.zeros(len(_IRON))
        self._norm = math.nan
        self._bias: FloatArray | None = None

    def resume(self) -> None:
        """Find north again after a pause; keep iron, lag and the evidence."""
        self._kept["begun"] = False
        self._bias = None

    def follow(self, bins: Any, bias_rad_s: FloatArray) -> Headings:
        """Take in bins; `bias_rad_s`, shape (n, 3), is the bias with which each one's steps ended."""
        bins = bins.copy()
        before = bias_rad_s[:1] if self._bias is None else self._bias[None]
        bins["bias_change"] = np.diff(bias_rad_s, axis=0, prepend=before)
        self._bias = bias_rad_s[-1].copy()
        found = self._run(bins, 1)
        weights = np.array([self._weights(*each) for each in zip(bins, found["evidence"], strict=True)])
        return _mean(found, weights, bins)

    def smooth(self, bins: Any) -> Headings:
        """North over a whole stretch, smoothed backward."""
        n = len(bins)
        kept = [np.zeros((len(_IRON), n, *rest)) for rest in ((kernel.SIZE,), *3 * [2 * (kernel.SIZE,)])]
        found = self._run(bins, n, kept)
        evidence = np.nan_to_num(found["evidence"]).sum(axis=0) - self._handicap
        likely = np.where(evidence > evidence.max() - _NEGLIGIBLE, evidence, -np.inf)
        weights = np.tile(_shares(likely), (n, 1))
        for j in np.flatnonzero(weights[0]):
            found["turn_rad"][:, j], found["variance"][:, j] = _backward(bins, *(each[j] for each in kept))
        return _mean(found, weights, bins)

    def _run(self, bins: Any, readings: int, kept: list[FloatArray] | None = None) -> Any:
        """What each filter finds in each bin, shape (n, filters); the norm is that of the first readings."""
        if not math.isfinite(self._norm) and bins["seen"].any():
            first = bins["field"][bins["seen"]][:readings]
            self._norm = float(np.median(np.linalg.norm(first, axis=1)))
        if self._norm > 0.0:
            bins["field"] /= self._norm
            bins["field_rate"] /= self._norm
        found = np.zeros((len(_IRON), len(bins)), kernel.FOUND)
        none = [np.zeros((0, kernel.SIZE)), *3 * [np.zeros((0, kernel.SIZE, kernel.SIZE))]]
        for j in range(len(_IRON)):
            into = none if kept is None else [each[j] for each in kept]
            kernel.find_headings(bins, self._room, self._kept[j : j + 1], found[j], *into)
        return found.T

    def _weights(self, bin_: Any, evidence: FloatArray) -> FloatArray:
        """Weights of the filters after one more bin; a sensor at rest repeats itself and proves nothing."""
        if not bin_["resting"]:
            self._scores = math.exp(-bin_["span_s"] / _MEMORY_S) * self._scores + np.nan_to_num(evidence)
        return _shares(self._scores - self._handicap)


def _shares(evidence: FloatArray) -> FloatArray:
    """Weights by logarithms of evidence."""
    likely = np.exp(evidence - evidence.max())
    return np.asarray(likely / likely.sum())


def _mean(found: Any, weights: FloatArray, bins: Any) -> Headings:
    """Mean and deviation of the filters' angles by weights, shape (n, filters)."""
    best = np.take_along_axis(found["turn_rad"], weights.argmax(axis=1)[:, None], axis=1)
    off = np.angle(np.exp(1j * (found["turn_rad"] - best)))
    mean = (weights * off).sum(axis=1)
    variance = (weights * (found["variance"] + (off - mean[:, None]) ** 2)).sum(axis=1)
    trust, stray = ((weights * found[name]).sum(axis=1) for name in ("trust", "stray"))
    disturbed = bins["seen"] & (trust < _DISTRUSTED)
    return Headings(best[:, 0] + mean, np.sqrt(variance), disturbed, stray, 1.0 - weights[:, 0])


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
    early = bins[1 : first + 1]
    moving_s = early["span_s"] * ~early["resting"]
    slip = moving_s * (early["level"][:, 2] @ means[0, kernel.BIAS : kernel.BIAS + 3])
    grown = early["slip_rad2"] + moving_s**2 * early["bias_variance"]
    turn = np.unwrap(found[:, 0])
    turn = np.concatenate([turn[0] + np.cumsum(slip[::-1])[::-1], turn])
    return turn, np.concatenate([found[0, 1] + np.cumsum(grown[::-1])[::-1], found[:, 1]])
