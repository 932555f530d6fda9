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
.. [4] V. H. de la Pena, T. L. Lai, Q.-M. Shao, "Self-normalized processes", Springer, 2009.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import softmax

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.kernels.orientation import heading as kernel
from speckle3d.kernels.orientation.inclination import BLOCK_S, STEP
from xsens.logs.samples import finite_rows, median

_FILTERS = 3
_FIRST, _BESIDE, _IRON = range(_FILTERS)
"""The three filters."""

_BESIDE_ODDS, _IRON_ODDS = 3.0, 4.0
"""Logarithms of the odds against each: one recording in twenty begins beside iron, one in fifty has it on the
sensor. Until the sensor turns, what is claimed with iron is what these odds make of it."""

_PLAIN = 100.0
"""Logarithm of the likelihood from which the heading is that with iron: claims cover both before. An uneven
field has as much in one place; BROAD's undisturbed trials have less than 60, one 190, in which both agree."""

_STRAY = 0.01
"""At first: of the norm, per component; a room without iron near."""

_FIRST_STRAY = 0.25
"""The first reading's stray while samples arrive, as a fraction: the first readings are all there is, and a
rough room would swing the heading about. A recording tells it in full."""

_LEAST_TRUST = 0.5

_ROUNDING = 1e-12
"""Variance that keeps covariances invertible: (1 microradian)^2, a millionth of the field, 1 microsecond."""

_NEGLIGIBLE = 0.005
"""Filters of less weight are not smoothed."""


BIN_S = 0.25
"""Readings are averaged over this time: the heading's error changes in seconds."""

_STEADY_S = 60.0
"""Time over which the gyroscope is trusted to hold the heading within its error."""

_STEADY = round(_STEADY_S / BIN_S)

_FIRST_BINS = round(1.0 / BIN_S)
"""Readings whose mean is north where the sensor was at first."""

STEPS_PER_BIN = round(BIN_S / BLOCK_S)
"""Steps of the filter of inclination."""

_MOVING_BIAS_RAD_S = np.deg2rad(0.05)
"""How far the bias in movement is from that at rest: an error of half the gyroscope's resolution at rest,
acceleration and vibration."""

_FIRST_PLACE = 0.01
"""Standard deviation of what the first place adds to the room's field, where north is found: 1 % of its norm
per component, a fifth of that of another place."""


def averaged_bins(rows: Any) -> Any:
    """Average steps, rows of `speckle3d.kernels.orientation.inclination.STEP`, to rows of `kernel.BIN`."""
    firsts = np.arange(0, len(rows), STEPS_PER_BIN)
    ends = np.append(firsts[1:], len(rows))
    lasts, counts, bins = ends - 1, ends - firsts, np.zeros(len(firsts), kernel.BIN)
    bins["span_s"] = np.add.reduceat(rows["duration_s"], firsts)
    bins["resting"] = np.logical_and.reduceat(rows["resting"], firsts)
    bins["slip_rad2"] = np.add.reduceat(rows["noise"][:, 2], firsts)
    bins["bias"] = rows["bias"][lasts]
    bins["bias_variance"] = (rows["sd"][lasts, 3:] ** 2).mean(axis=1) + _MOVING_BIAS_RAD_S**2
    bins["tilt_rad2"] = np.add.reduceat((rows["sd"][:, :2] ** 2).mean(axis=1), firsts) / counts
    readable = finite_rows(rows["field"])
    readings = np.add.reduceat(readable.astype(float), firsts)[:, None]
    bins["seen"] = readings[:, 0] > 0.0
    field, level = np.where(readable[:, None], rows["field"], 0.0), Rotation.from_quat(rows["start"])
    bins["level"] = np.add.reduceat(level.as_matrix(), firsts) / counts[:, None, None]
    turning = np.cross(rows["rate"] - rows["bias"], field)
    for name, vectors in (("field", field), ("field_rate", turning)):
        bins[name] = np.add.reduceat(level.apply(vectors), firsts) / np.maximum(readings, 1.0)
    return bins


UNKNOWN = (0.0, np.pi, False, np.nan, np.nan)
"""What is told at the end of a bin, here where no field has told the heading: the angle about up from level
axes to north; its deviation; whether the reading was hardly believed; how much the field changes from place
to place, a fraction of its norm, per component; the weight of the filter that takes iron to be on the sensor,
0 to 1."""


class HeadingFilter:
    """The three filters, bin by bin; `online` if the readings so far are all there is."""

    def __init__(self, online: bool = True) -> None:
        stray = _FIRST_STRAY if online else 1.0
        models = [  # a calibration leaves 0.002 of iron
            (0.002, 0.0, _FIRST_PLACE, False, stray),
            (0.002, 0.0, 0.3, True, stray),
            (0.7, 0.15, _FIRST_PLACE, False, stray),
        ]
        self._models = np.array(models, kernel.MODEL)
        self._begin(_STRAY)
        self.resume()

    def _begin(self, stray: float) -> None:
        self._filters = np.zeros(_FILTERS, kernel.FILTER)
        self._filters["stray"] = stray
        self._evidence = np.zeros((1, 4))  # for iron over each of the others, and its squares

    def resume(self) -> None:
        """Find north again after a pause; keep iron, lag and the evidence."""
        self._filters["begun"] = False
        self._rows = np.zeros(0, STEP)  # steps of a bin that is not whole
        self._north = np.zeros((0, len(UNKNOWN)))  # at the end of the last bin
        self._lately = np.zeros((0, _FILTERS + 1))  # angles of the filters, and slip
        self._walks, self._bins = 0.0, 0  # north's, summed over minutes, and how many bins there were

    def follow(self, rows: Any, to_end: bool = False) -> FloatArray:
        """Values as in `UNKNOWN` after each step by the last whole bin; `to_end` what is left is one."""
        before, north = len(self._rows), self._north
        rows = np.concatenate([self._rows, rows]) if before else rows
        bin_of_row = (np.arange(before, len(rows)) + 1) // STEPS_PER_BIN + len(north) - 1
        whole = len(rows) if to_end else len(rows) // STEPS_PER_BIN * STEPS_PER_BIN
        self._rows = rows[whole:].copy()
        if whole:
            bins = averaged_bins(rows[:whole])
            estimates = self._run(bins)
            weights, best = self._weights(estimates)
            # A walk at random: its variance grows with time, by the mean of the minutes so far. It is that of
            # sizes (normal ones), not of squares: a single jump, as where iron is left behind, is no walk.
            sizes = np.sqrt(0.5 * np.pi * self._unsteady(estimates, best, bins))
            walks = self._walks + np.cumsum(sizes) / _STEADY
            minutes = (self._bins + 1.0 + np.arange(len(bins))) / _STEADY
            unsteady = (walks / np.maximum(minutes - 1.0, 1.0 / _STEADY)) ** 2 * minutes
            self._walks, self._bins = float(walks[-1]), self._bins + len(bins)
            north = np.concatenate([north, _combine(estimates, weights, best, bins, unsteady)])
        self._north = north[-1:]
        north = north if len(north) else np.array([UNKNOWN])
        return north[np.clip(bin_of_row, 0, len(north) - 1)]

    def smooth(self, bins: Any) -> FloatArray:
        """North over a whole stretch, smoothed backward; the stray at first is the recording's."""
        bins["bias"] = 0.0  # with a smoothed bias, there is no better one to come
        rows, moving = self._run(bins), ~bins["resting"]
        best = self._weights(rows)[1][-1]
        self._begin(max(median(rows["stray"][moving, best], 0.0), _STRAY))
        arrays = _empty_arrays(_FILTERS, len(bins))
        rows = self._run(bins, arrays)
        weights, best = (values[-1] for values in self._weights(rows))
        best_filters = np.full(len(bins), best)
        # What passes, as iron at the start, is smoothed.
        later = self._unsteady(rows, best_filters, bins)[_STEADY:]
        unsteady = np.median(later) if later.size > _STEADY // 4 else 0.0
        weights[weights < _NEGLIGIBLE] = 0.0
        for j in np.union1d(np.flatnonzero(weights), best):
            states, rows["turn_rad"][:, j], rows["variance"][:, j] = _smooth_backward(
                *(part[j] for part in arrays)
            )
            if j == best != _BESIDE:
                unsteady += _first_misfit(bins, states, self._filters["norm"][j])
        return _combine(rows, np.tile(weights, (len(bins), 1)), best_filters, bins, unsteady)

    def _weights(self, rows: Any) -> tuple[FloatArray, IntArray]:
        """Weights of the filters after each bin, shape (n, filters), and the one whose heading is taken.

        Evidence counts by its sum over its own scatter [4]_, which is at least twice the sum: what comes in
        bursts, as of an uneven field, proves little however large it is, and no bin more than half.
        """
        gain = rows["evidence"][:, _IRON:] - rows["evidence"][:, :_IRON]
        sums = np.cumsum(np.vstack([self._evidence, np.hstack([gain, gain**2])]), axis=0)[1:]
        self._evidence = sums[-1:]
        total, squares = np.hsplit(sums, 2)
        proof = 0.5 * total * abs(total) / (squares + 2.0 * np.maximum(total, 0.0) + _ROUNDING)
        beside = _BESIDE_ODDS + rows["doubt"][:, _BESIDE] - rows["doubt"][:, _FIRST]
        iron = _IRON_ODDS - proof.min(axis=1) + np.minimum(beside, 0.0)
        against = np.column_stack([np.zeros(len(rows)), beside, iron])
        best = np.where(total.min(axis=1) > _PLAIN, _IRON, np.where(beside < 0.0, _BESIDE, _FIRST))
        return softmax(-against, axis=1), best

    def _unsteady(self, rows: Any, best: IntArray, bins: Any) -> FloatArray:
        """Square of what the best filter's north has moved against the gyroscope, beyond its error.

        Zero in the first minute, in which filters find what the field is.
        """
        lately = np.vstack([self._lately, np.column_stack([rows["turn_rad"], bins["slip_rad2"]])])
        last = len(self._lately) + np.arange(len(bins))
        first = np.maximum(last - _STEADY, 0)
        slip = np.cumsum(lately[:, _FILTERS])
        gyroscope = slip[last] - slip[first] + bins["bias_variance"] * _STEADY_S**2
        self._lately = lately[-_STEADY:]
        move = _angle(lately[last, best] - lately[first, best])
        return np.where(last < _STEADY, 0.0, np.maximum(move**2 - gyroscope, 0.0))

    def _run(self, bins: Any, arrays: list[FloatArray] | None = None) -> Any:
        """What each filter finds in each bin, shape (n, filters)."""
        rows = np.zeros((len(bins), _FILTERS), kernel.HEADING)
        kernel.find_headings(bins, self._models, self._filters, rows, *(arrays or _empty_arrays(0, 0)))
        return rows


def _angle(difference: FloatArray) -> Any:
    return np.angle(np.exp(1j * difference))


def _empty_arrays(*shape: int) -> list[FloatArray]:
    """Arrays for states, covariances, transitions and noises."""
    size = kernel.SIZE
    return [np.zeros((*shape, *dims)) for dims in ((size,), *3 * [(size, size)])]


def _combine(rows: Any, weights: FloatArray, best: IntArray, bins: Any, more_rad2: Any) -> FloatArray:
    """Values as in `UNKNOWN` of each bin: the best filter's angle, and deviation of all from it."""
    turn = np.take_along_axis(rows["turn_rad"], best[:, None], axis=1)
    off = _angle(rows["turn_rad"] - turn)
    variance = np.minimum((weights * (rows["variance"] + off**2)).sum(axis=1) + more_rad2, np.pi**2)
    trust, stray = ((weights * rows[name]).sum(axis=1) for name in ("trust", "stray"))
    distrust = bins["seen"] & (trust < _LEAST_TRUST)
    return np.column_stack([turn, np.sqrt(variance), distrust, stray, weights[:, _IRON]])


def _smooth_backward(
    states: FloatArray, covariances: FloatArray, transitions: FloatArray, noises: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """States, angle and variance of one filter, smoothed; before the first reading as there."""
    from filterpy.kalman import KalmanFilter

    first = int(np.argmax(covariances[:, 0, 0] > 0.0))
    smoother = KalmanFilter(dim_x=kernel.SIZE, dim_z=3)
    arrays = (states, covariances, transitions, noises + _ROUNDING * np.eye(kernel.SIZE))
    means, spread, _, _ = smoother.rts_smoother(*(part[first:] for part in arrays))
    turns = np.array([kernel.turn_to_north(x, p) for x, p in zip(means, spread, strict=True)])
    turn, variance = np.pad(turns, ((first, 0), (0, 0)), mode="edge").T
    return np.pad(means, ((first, 0), (0, 0)), mode="edge"), np.unwrap(turn), variance


def _first_misfit(bins: Any, states: FloatArray, norm: float) -> float:
    """Square of the angle from the smoothed north to that of the first readings, which ought to be it."""
    first = np.flatnonzero(bins["seen"])[:_FIRST_BINS]
    iron = np.einsum("nij,nj->ni", bins["level"][first], states[first, kernel.IRON : kernel.IRON + 3])
    fields = bins["field"][first] / norm - iron, states[first]
    angles = [np.arctan2(field[:, 1], field[:, 0]) for field in fields]
    return float(_angle(angles[0] - angles[1]).mean() ** 2)
