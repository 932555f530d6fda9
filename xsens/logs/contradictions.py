"""Consistency of a log's gyroscope, accelerometer, magnetometer and own orientation.

A direction u that rests in the world changes in the sensor's axes at the rate u x w, with w the gyroscope's.
Three are read: up by the accelerometer, north by the magnetometer, and any by the sensor's own orientation.
Movement makes the accelerometer show more turning, never less, except that of a free pendulum.
"""

from __future__ import annotations

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray
from xsens.logs.samples import ImuLog, finite_rows, median_norm, row_norms

FORCE_M_S2 = (4.0, 25.0)
"""Limits of the median of the accelerometer's norm if it is in m/s^2."""

FASTEST_RAD_S = 60.0
"""The widest range of the sensors' gyroscopes ends at 35 rad/s about an axis, and a hand's ordinary movement
in deg/s exceeds 60."""

_COMPARED_S = 0.1
"""Interval over which turns are compared: a hand turns by less than a radian in it."""

_MOVING_RAD_S = 0.1
"""Smallest RMS rate that is compared: six degrees per second, beyond any bias."""

_LEAST_TURN = 0.4
"""RMS rate, of what movement makes, from which a gyroscope must be followed. BROAD's trials and two kinds of
simulated hands are never accused from 0.3 on; of 48 in which the gyroscope is wrong the field accuses 41."""

_ERRORS, _BLOCK = 4.0, 10
"""Standard errors by which a share must be off, by the scatter of so many intervals, a second, together."""

_HONEST_SHARES = (0.7, 1.6)
"""Share of the gyroscope's turn that the other must show, in all and about each axis: 1 if all is right, 1/57
if the unit is deg/s, another if the rate of samples is, -1 or about 0 if axes are exchanged. BROAD's trials
and simulated hands show 0.78 to 1.16, by the field 0.91 to 1.16; rocking once a second about a point 0.07 m
above the sensor shows 0.7, 0.12 m below it 1.5."""

_ABOUT_AXIS = 0.9
"""Share of the turn missed by a gyroscope that is about an axis which stands still. By the field, BROAD's
trials with an axis set to zero show 0.8 to 1.0, and any axis as it is 0.4 to 0.91."""

_UPWARD = 0.5
"""Sine of the field's rise that is told, 30 degrees: in a room with iron an MT9-B's field rises by one."""

_CALM = 0.1
"""Share of its median by which the length may differ where acceleration is gravity, and the field Earth's."""

_FEWEST = 20


def contradictions(log: ImuLog) -> dict[str, str | None]:
    """Sentences on what is contradicted, by what contradicts it; empty where that agrees with the gyroscope.

    What tells nothing, as an accelerometer of a sensor that turns about the vertical alone, is left out.
    """
    rate, force, field = log.gyroscope_rad_s, log.accelerometer_m_s2, log.magnetometer_au
    directions = {"accelerometer": force, "magnetometer": field, "own orientation": log.own_direction}
    sentences: dict[str, str | None] = {"gyroscope": ""}
    if rate is not None and (fast := float(np.nanpercentile(row_norms(rate), 99.0))) > FASTEST_RAD_S:
        sentences["gyroscope"] = (
            f"expected a gyroscope in rad/s, got one in a hundred over {fast:.3g}: in deg/s?"
        )
    for name, direction in directions.items():
        if rate is None or direction is None:
            continue
        if dead := _dead_axis(rate, direction):
            sentences[f"{name}'s axis"] = (
                f"the {name}'s {dead} axis reads the same while the gyroscope turns it"
            )
            continue
        if not (turns := _turns(log.time_s, rate, direction)):
            continue
        sentences["gyroscope"] = sentences["gyroscope"] or _still_axis(name, *turns)
        sentences[name] = _against_gyroscope(name, *turns[:2])
        if sentences[name] and direction is field:
            freed = _turns(log.time_s, rate, _without_iron(log.time_s, rate, direction))
            if freed and len(freed[1]) >= len(turns[1]):  # as steady as before, or more
                sentences[name] = _against_gyroscope(name, *freed[:2])
    if force is not None:
        sentences["gravity"] = not_in_metres(force)
    if force is not None and field is not None:
        up = np.einsum("ij,ij->i", force, field) / np.maximum(row_norms(force) * row_norms(field), 1e-12)
        up = up[np.isfinite(up)]
        if up.size and np.median(up) > _UPWARD:
            sentences["dip"] = (
                "the field points up, as south of the magnetic equator: if this is north of it, magnetometer "
                "or accelerometer are negated, and the heading is off by half a turn"
            )
    return sentences


def not_in_metres(force: FloatArray) -> str:
    """Sentence on an accelerometer, shape (m, 3), that is not in m/s^2; empty for one that is."""
    median = median_norm(force)
    if not (median <= FORCE_M_S2[0] or median >= FORCE_M_S2[1]):
        return ""
    unit = ": in g, without saying so?" if 0.9 < median < 1.1 else ""
    return f"expected an accelerometer in m/s^2, with norm near 9.8, got a median of {median:.3g}{unit}"


def _turns(
    time_s: FloatArray, rate: FloatArray, direction: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray] | None:
    """What the gyroscope's turns make of a direction that rests in the world; None if it tells nothing.

    Returns
    -------
    ndarray, shape (3, n, 3)
        Rate of the direction by the gyroscope's turn about each axis.
    ndarray, shape (n, 3)
        That by the direction's readings.
    ndarray, shape (3, n, 3)
        What a unit rate about each axis makes of it.
    ndarray of bool, shape (3, n)
        Whether an axis of the gyroscope reads the same as before, while others do not.
    """
    rows = np.column_stack([time_s, rate, direction])[finite_rows(rate) & finite_rows(direction)]
    if len(rows) <= _FEWEST:
        return None
    width = max(1, round(_COMPARED_S / float(np.median(np.diff(rows[:, 0])))))
    count = len(rows) // width
    rows = rows[: count * width].reshape(count, width, 7).mean(axis=1)
    step_s, rates, norm = np.diff(rows[:, 0]), rows[:, 1:4], row_norms(rows[:, 4:])
    calm = np.abs(norm / np.median(norm) - 1.0) < _CALM
    calm = calm[1:] & calm[:-1] & (step_s < 2.0 * np.median(step_s))
    if calm.sum() < _FEWEST:
        return None
    u = rows[:, 4:] / np.maximum(norm, 1e-9)[:, None]
    change = (np.diff(u, axis=0) / step_s[:, None])[calm]
    arms = np.cross(0.5 * (u[1:] + u[:-1])[calm], np.eye(3)[:, None])
    turns = arms * (0.5 * (rates[1:] + rates[:-1])[calm]).T[:, :, None]
    if max(_rms(turns.sum(axis=0)), _rms(change)) < _MOVING_RAD_S:
        return None
    same = np.diff(rates, axis=0)[calm].T == 0.0
    return turns, change, arms, same & ~same.all(axis=0)


def _without_iron(time_s: FloatArray, rate: FloatArray, field: FloatArray) -> FloatArray:
    """The field less that of iron on the sensor, b: with it the field changes at the rate u x w + w x b."""
    rows = finite_rows(rate) & finite_rows(field)
    seen, turn = field[rows], rate[rows][1:] * np.diff(time_s[rows])[:, None]
    off = np.diff(seen, axis=0) - np.cross(0.5 * (seen[1:] + seen[:-1]), turn)
    by_axis = np.cross(turn[:, None], np.eye(3)).swapaxes(1, 2)
    return field - np.linalg.lstsq(by_axis.reshape(-1, 3), off.ravel())[0]


def _dead_axis(rate: FloatArray, direction: FloatArray) -> str:
    """Axis in which a direction never changes, although it turns in the sensor's axes; empty if none."""
    valid = finite_rows(rate) & finite_rows(direction)
    rows, change = direction[valid], np.cross(direction[valid], rate[valid])
    for axis, column, turned in zip("xyz", rows.T, change.T, strict=True):
        still = len(rows) > _FEWEST and (column == column[0]).all()
        if still and _rms(turned[:, None]) > _MOVING_RAD_S * median_norm(rows):
            return axis
    return ""


def _still_axis(name: str, turns: FloatArray, change: FloatArray, arms: FloatArray, same: BoolArray) -> str:
    """Sentence on an axis of the gyroscope that stands still while a direction turns about it."""
    missed = change - turns.sum(axis=0)
    for axis, arm, rows in zip("xyz", arms, same, strict=True):
        if rows.sum() > _FEWEST:
            along = (missed * arm)[rows].sum(axis=1) / np.maximum(row_norms(arm[rows]), 1e-9)
            if _rms(along[:, None]) > max(_ABOUT_AXIS * _rms(missed[rows]), _MOVING_RAD_S):
                return f"the gyroscope's {axis} axis reads the same while the {name} turns about it"
    return ""


def _against_gyroscope(name: str, turns: FloatArray, change: FloatArray) -> str | None:
    """Sentence on a direction that turns unlike the gyroscope; empty if it agrees, None if unknown."""
    whole = turns.sum(axis=0)
    missed, agrees = change - whole, False
    for axis, turn in (("", whole), *zip((" x", " y", " z"), turns, strict=True)):
        rate, square = _rms(turn), max((turn**2).sum(), 1e-12)
        share = 1.0 + (turn * missed).sum() / square
        rest = missed + (1.0 - share) * turn
        scatter = np.add.reduceat((turn * rest).sum(axis=1), np.arange(0, len(turn), _BLOCK))
        error = _ERRORS * float(np.sqrt((scatter**2).sum())) / square
        low, high = _HONEST_SHARES
        agrees |= not axis and low < share - error and share + error < high
        clear = rate * max(share, 1.0) > max(_LEAST_TURN * _rms(rest), _MOVING_RAD_S)
        if clear and (share + error < low or share - error > high):
            doubt = "are rate, axes and signs as they are told"
            if 0.0 < share < 0.05 or share > 20.0:
                doubt = f"is the gyroscope in {'rad' if share > 1.0 else 'deg'}/s"
            return (
                f"gyroscope{axis} and {name} contradict each other: the one turns by {rate:.2g} rad/s, the "
                f"other shows {100.0 * share:.3g} % of it: {doubt}?"
            )
    return "" if agrees else None


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt(np.mean(row_norms(vectors) ** 2)))
