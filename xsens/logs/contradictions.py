"""Consistency of a log's gyroscope, accelerometer, magnetometer and own orientation.

A direction that rests in the world turns in the sensor's axes against the gyroscope's turn. Three are read:
up by the accelerometer, north by the magnetometer, and any by the sensor's own orientation. Each is averaged
over a quarter of a second in axes that the gyroscope carries along, and compared with its mean in the next.
Over shorter times a hand's acceleration, which averages to nothing over its swings, shows turns of its own.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from xsens.logs.samples import ImuLog, finite_rows, median, median_norm, row_norms

FORCE_M_S2 = (8.0, 12.5)
"""Limits of the median of the accelerometer's norm if it is in m/s^2 and of the right range: BROAD's trials
have 9.82 to 9.95, two sensors out of calibration 9.0 and 9.4."""

FASTEST_RAD_S = 60.0
"""The widest range of the sensors' gyroscopes ends at 35 rad/s about an axis, and a hand's ordinary movement
in deg/s exceeds 60."""

_WINDOW_S = 0.25
"""Over 0.1 s a hand that rocks twice a second about a point 0.1 m away is accused by its acceleration; over
0.5 s a wrong gyroscope carries a fast hand's readings so far apart that their mean tells little."""

_MOVING_RAD_S, _VISIBLE = 0.05, 0.25
"""Smallest RMS rate that is compared, three degrees per second, and share of the gyroscope's in all: errors
of scale and axes make 3 to 5 % of the latter appear in any direction."""

_ERRORS = 4.0
"""Standard errors, by the scatter of the windows, by which a share must be off."""

_HONEST_SHARES = (0.75, 1.4)
"""Share of the gyroscope's turn that the other must show, in all and about each axis: 1 if all is right, 1/57
if the unit is deg/s, another if the rate of samples is, -1 or about 0 if axes are exchanged. BROAD's trials
and simulated hands with errors of scale of 3 % show none outside 0.8 to 1.25."""

_CALIBRATED = 0.02
"""Error of the gyroscope's scale that is foreseen: more widens what is claimed. BROAD's trials show 1 % by
the accelerometer. Iron on the sensor makes as much of a field's turn."""

_COHERENCE = 0.9
"""Least length of means of readings of length one. Simulated hands have 0.94, BROAD's trials 0.99; in
deg/s the gyroscope carries readings all around, and noise has no direction."""

_EXPLAINED = 0.5
"""Share of what a field's turn misses that is left if iron on the sensor makes it."""

_ABOUT_AXIS = 0.9
"""Share of the turn missed by a gyroscope that is about an axis which stands still."""

_UPWARD = 0.5
"""Sine of the field's rise that is told, 30 degrees: in a room with iron an MT9-B's field rises by one."""

_CALM = 0.1
"""Share of its median by which the length may differ where acceleration is gravity, and the field Earth's."""

_FEWEST = 8


class _Turns(NamedTuple):
    """Turns of a direction from each of n windows to the next, shape (n, 3).

    `expected` by the gyroscope, in all and about each of its axes; what is `missed` of the direction's turn,
    and of that what iron on the sensor does not make; `arms`, what a unit turn about each axis makes; `same`,
    shape (3, n), where an axis of the gyroscope, not all, reads the same; its RMS rate; `coherence`, median
    length of the windows' means of a direction of length one.
    """

    expected: Sequence[FloatArray]
    missed: FloatArray
    unlike_iron: FloatArray
    arms: FloatArray
    same: BoolArray
    rate_rad_s: float
    coherence: float


def contradictions(log: ImuLog) -> tuple[dict[str, str | None], float]:
    """Compare a log's sensors with its gyroscope.

    Returns
    -------
    dict of str to str, or None
        Sentences on what is contradicted, by what contradicts it; empty where that agrees with the gyroscope.
        What tells nothing, as an accelerometer of a sensor that turns about the vertical alone, is left out.
    float
        Share of its turns by which the gyroscope is off; 0 if it is as foreseen.
    """
    rate, force, field = log.gyroscope_rad_s, log.accelerometer_m_s2, log.magnetometer_au
    directions = {"accelerometer": force, "magnetometer": field, "own orientation": log.own_direction}
    sentences: dict[str, str | None] = {"gyroscope": ""}
    scale_errors, readings = list[float](), dict[str, FloatArray]()
    if rate is not None and (fast := np.nanpercentile(row_norms(rate), 99.0)) > FASTEST_RAD_S:
        sentences["gyroscope"] = (
            f"expected a gyroscope in rad/s, got one in a hundred over {fast:.3g}: in deg/s?"
        )
    for name, rows in directions.items():
        if rate is None or rows is None:
            continue
        if dead := _dead_axis(rate, rows):
            sentences[f"{name}'s axis"] = (
                f"the {name}'s {dead} axis reads the same while the gyroscope turns it"
            )
        else:
            readings[name] = rows
    for name, turns in _turns(log.time_s, rate, readings):
        sentences["gyroscope"] = sentences["gyroscope"] or _still_axis(name, turns)
        sentences[name], scale_error = _against_gyroscope(name, turns)
        if name != "magnetometer":
            scale_errors += [scale_error] if sentences[name] == "" else []
        elif sentences[name] and _rms(turns.unlike_iron) < _EXPLAINED * _rms(turns.missed):
            sentences[name] = None
    scale_error = min(scale_errors, default=0.0)
    if scale_error > 0.0:
        sentences["scale"] = f"the gyroscope's turns are off by {100.0 * scale_error:.2g} %: less is claimed"
    if force is not None:
        sentences["gravity"] = not_in_metres(force)
    if force is not None and field is not None:
        up = np.einsum("ij,ij->i", force, field)
        if median(up / np.maximum(row_norms(force) * row_norms(field), 1e-12)) > _UPWARD:
            sentences["dip"] = (
                "the field points up, as south of the magnetic equator: if this is north of it, magnetometer "
                "or accelerometer are negated, and the heading is off by half a turn"
            )
    return sentences, scale_error


def not_in_metres(force: FloatArray) -> str:
    """Sentence on an accelerometer, shape (m, 3), that is not in m/s^2; empty for one that is."""
    median = median_norm(force)
    if not (median <= FORCE_M_S2[0] or median >= FORCE_M_S2[1]):
        return ""
    unit = ": in g, without saying so?" if 0.9 < median < 1.1 else ": of another range or unit?"
    return f"expected an accelerometer in m/s^2, with norm near 9.8, got a median of {median:.3g}{unit}"


def _turns(time_s: FloatArray, rate: Any, directions: dict[str, FloatArray]) -> Iterator[tuple[str, _Turns]]:
    """Turns of each direction that rests in the world and tells something, less those by a bias."""
    rows: Any = np.flatnonzero(finite_rows(rate)) if directions else []
    if len(rows) <= _FEWEST:
        return
    from speckle3d.kernels.orientation.windows import window_sums  # which loads numba

    steps_s: Any = np.diff(time_s[rows], append=time_s[rows[-1]])
    usual_s, rates = median(steps_s), rate[rows]
    width = max(1, round(_WINDOW_S / usual_s))
    readings = np.stack([part[rows] for part in directions.values()])
    turn, carried, sums = window_sums(steps_s, rates, readings, width)
    rotations = Rotation.from_quat(turn[:-1])
    back, turns_rad = rotations.inv().as_matrix(), rotations.as_rotvec()
    # What rests in the sensor's axes makes so much of a direction's turn.
    iron = np.moveaxis(carried[1:] - back @ carried[:-1], 2, 0)
    windows, rate_rad_s = len(turn) * width, _rms(rates)
    even = (steps_s[:windows].reshape(-1, width) <= 2.0 * usual_s).all(axis=1)
    rates = rates[:windows].reshape(-1, width, 3)
    same = (rates == rates[:, :1]).all(axis=1)[:-1].T
    same &= ~same.all(axis=0)
    for name, window in zip(directions, sums, strict=True):
        count = np.maximum(window[:, 4], 1.0)
        length = window[:, 3] / count
        usual = max(median(length), 1e-9)
        calm = (np.abs(length / usual - 1.0) < _CALM) & even
        calm = calm[1:] & calm[:-1]
        if calm.sum() < _FEWEST:
            continue
        mean = window[:, :3] / (usual * count)[:, None]
        before, after = mean[:-1][calm], mean[1:][calm]
        ahead = (back[calm] @ before[:, :, None])[:, :, 0]
        coherence = usual * median(row_norms(after) / length[1:][calm])
        arms = np.cross(0.5 * (ahead + before), np.eye(3)[:, None])
        turned = arms * turns_rad[calm].T[:, :, None]
        missed, *expected = _without(arms, [after - ahead, ahead - before, *turned])
        (unlike_iron,) = _without(np.concatenate([arms, iron[:, calm]]), [missed])
        yield name, _Turns(expected, missed, unlike_iron, arms, same[:, calm], rate_rad_s, coherence)


def _without(columns: FloatArray, parts: Sequence[FloatArray]) -> FloatArray:
    """Parts, shape (k, n, 3), less the combinations of columns, shape (j, n, 3), that are nearest to them."""
    basis, stack = (np.reshape(rows, (len(rows), -1)).T for rows in (columns, parts))
    rest = stack - basis @ np.linalg.lstsq(basis, stack)[0]
    return rest.T.reshape(len(parts), -1, 3)


def _dead_axis(rate: FloatArray, direction: FloatArray) -> str:
    """Axis in which a direction never changes, although it turns in the sensor's axes; empty if none."""
    for k in np.flatnonzero(np.fmin.reduce(direction) == np.fmax.reduce(direction)):
        valid = finite_rows(rate) & finite_rows(direction)
        rows = direction[valid]
        turned = np.cross(rows, rate[valid])[:, k : k + 1]
        if len(rows) > _FEWEST and _rms(turned) > 2.0 * _MOVING_RAD_S * median_norm(rows):
            return "xyz"[k]
    return ""


def _still_axis(name: str, turns: _Turns) -> str:
    """Sentence on an axis of the gyroscope that stands still while a direction turns about it."""
    for axis, arm, rows in zip("xyz", turns.arms, turns.same, strict=True):
        if rows.sum() > _FEWEST:
            missed = turns.missed[rows]
            along = (missed * arm[rows]).sum(axis=1) / np.maximum(row_norms(arm[rows]), 1e-9)
            if _rms(along[:, None]) > max(_ABOUT_AXIS * _rms(missed), 2.0 * _MOVING_RAD_S * _WINDOW_S):
                return f"the gyroscope's {axis} axis reads the same while the {name} turns about it"
    return ""


def _against_gyroscope(name: str, turns: _Turns) -> tuple[str | None, float]:
    """Sentence on a direction that turns unlike the gyroscope; empty if it agrees, None if unknown.

    With it comes the share of its turns by which the gyroscope is off, 0 if that is as foreseen.
    """
    low, high = _HONEST_SHARES
    contradiction = "gyroscope{} and {} contradict each other: the one turns by {:.2g} rad/s, the other {}?"
    if turns.coherence < _COHERENCE:
        doubt = "otherwise: is one noise, or the gyroscope in deg/s"
        return contradiction.format("", name, turns.rate_rad_s, doubt), 0.0
    verdict, scale_error = None, 0.0
    for axis, turn in zip(("", " x", " y", " z"), turns.expected, strict=True):
        square = max((turn**2).sum(), 1e-12)
        off = (turn * turns.missed).sum() / square
        scatter = (turn * (turns.missed - off * turn)).sum(axis=1)
        error, share = _ERRORS * np.sqrt((scatter**2).sum()) / square, 1.0 + off
        rate = _rms(turn) / _WINDOW_S
        if rate * max(share, 1.0) < max(_MOVING_RAD_S, _VISIBLE * turns.rate_rad_s):
            continue
        if share + error < low or share - error > high:
            doubt = "are rate, axes and signs as they are told"
            if 0.0 < share < 0.05 or share > 20.0:
                doubt = f"is the gyroscope in {'rad' if share > 1.0 else 'deg'}/s"
            doubt = f"shows {100.0 * share:.3g} % of it: {doubt}"
            return contradiction.format(axis, name, rate, doubt), 0.0
        if not axis and low < share - error and share + error < high:
            verdict, scale_error = "", abs(off) if abs(off) > max(error, _CALIBRATED) else 0.0
    return verdict, scale_error


def _rms(vectors: FloatArray) -> Any:
    return np.sqrt(np.mean(row_norms(vectors) ** 2))
