"""Rows and poses of others' recordings: what is of no use is left out and told, the rest is kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.streams import TimedPoses
from speckle3d.core.sweep import Frames, Sweep

_FASTEST_MM_S, _SLACK_MM = 300.0, 3.0
"""Of a point of the probe between two readings. The fastest path at hand, a motor's, has 255 mm/s, freehand
sweeps of PLUS have at most 28; a jump of 22 mm in 50 ms is beyond. The slack is a tracker's noise and uneven
time stamps."""

_LEVER_MM = 50.0
"""From the sensor to points whose displacement stands for a rotation: half a probe's length."""

_MOST_JUMPING = 0.2
"""Share of poses after jumps, above which these are no faults of readings but how the probe was placed."""
_MOST_PIECES = 2000
"""Of a path cut at its jumps; with more it is no path."""

_MOST_ALIKE, _MOST_TIMES = 3, 3
"""Poses in a row that are the same to the last digit: a tracker's noise alone changes them, and 2 of 5,000 at
hand are alike. Of a tracker slower than the images, runs are regular: three times their median is odd."""

_LEAST_OF_WIDTH, _LONGEST_MM = 1 / 200, 3000.0
"""Length of a path as a share of the image's width, below which it is in metres or stands still; and the
longest a hand's may be. In the wrong unit it is a thousandth, or a thousand times."""


def rising(times: FloatArray) -> IntArray:
    """Indices of the longest strictly increasing part of `times`, shape (n,); NaN is left out.

    Of equal times the first one stays (patience sorting).
    """
    tails: list[float] = []
    last: list[int] = []
    before = np.full(times.size, -1)
    for i, time in enumerate(times.tolist()):
        if not np.isfinite(time):
            continue
        place = len(tails) if not tails or time > tails[-1] else int(np.searchsorted(tails, time))
        before[i] = last[place - 1] if place else -1
        if place == len(tails):
            tails.append(time)
            last.append(i)
        elif time < tails[place]:
            tails[place], last[place] = time, i
    chosen, i = [], last[-1] if last else -1
    while i >= 0:
        chosen.append(i)
        i = int(before[i])
    return np.array(chosen[::-1], dtype=int)


def left_out(what: str, total: int, reasons: Mapping[str, int], time_s: FloatArray) -> list[str]:
    """Tell how many rows are left out and why, and the longest gap between those that stay."""
    dropped = {reason: count for reason, count in reasons.items() if count}
    if not dropped:
        return []
    listed = ", ".join(f"{count} {reason}" for reason, count in dropped.items())
    text = f"{what}: {sum(dropped.values())} of {total} left out ({listed})"
    if time_s.size > 1:
        i = int(np.argmax(np.diff(time_s)))
        text += f"; the longest gap is {time_s[i + 1] - time_s[i]:.3g} s, after {time_s[i]:.3f} s"
    return [text]


def checked_path(sweep: Sweep, chain: str) -> tuple[Sweep, list[str]]:
    """Leave jumps out of a sweep's tracker, and tell what is odd of its path and how many poses match.

    Parameters
    ----------
    chain : str
        Where the poses are from, as ``ImageToProbe * ProbeToTracker``.
    """
    tracker = sweep.tracker
    if tracker is None:
        return sweep, []
    readings, notes = _without_jumps(tracker.readings)
    checked = replace(sweep, tracker=replace(tracker, readings=readings))
    assert checked.tracker is not None
    covered = checked.tracker.covers(sweep.frame_time_s)
    exact = np.isin(sweep.frame_time_s - tracker.time_offset_s, readings.time_s)
    between = np.count_nonzero(covered & ~exact)
    matched = (
        f"poses of {chain}, mm: {len(readings)} poses, {len(sweep)} images, {np.count_nonzero(covered)} "
        "matched" + (f", {between} of them between two poses" if between else "")
    )
    notes += _repeats(readings, sweep.frames, sweep.frame_time_s - tracker.time_offset_s)
    places = readings.world_from_sensor.translation
    extent = float(np.linalg.norm(np.ptp(places, axis=0)))
    width = sweep.grid.width_mm
    if len(readings) > 1 and (extent < _LEAST_OF_WIDTH * width or extent > _LONGEST_MM):
        unit = "metres" if extent < width else "micrometres"
        notes.append(
            f"poses: the path spans {extent:.3g} mm and the image is {width:.4g} mm wide: the probe stood "
            f"still, or the poses are in {unit}"
            if extent < width
            else f"poses: the path spans {extent:.3g} mm: are they in {unit}?"
        )
    return checked, [*notes, matched]


def _without_jumps(readings: TimedPoses) -> tuple[TimedPoses, list[str]]:
    """Keep the largest part of a path in which a hand reaches each pose from the one before.

    Where that leaves out more than a fifth, poses are single placements and not a path: all stay.
    """
    points, time_s = _points(readings.world_from_sensor), readings.time_s
    moved, steps = _apart(points[1:], points[:-1]), np.diff(time_s)
    jumps = np.flatnonzero(moved > _reach(steps))
    if not jumps.size:
        return readings, []
    worst = int(jumps[0])
    told = f"{moved[worst]:.3g} mm in {1e3 * steps[worst]:.3g} ms at {time_s[worst + 1]:.3f} s"
    starts, ends = np.r_[0, jumps + 1], np.r_[jumps, len(readings) - 1]
    keep = _largest_chain(points, time_s, starts, ends)
    if keep is None or np.count_nonzero(~keep) > _MOST_JUMPING * len(readings):
        return readings, [f"poses: {jumps.size} jumps that no hand makes, as {told}: all are kept"]
    notes = left_out("poses", len(readings), {f"after jumps, as {told}": int(np.sum(~keep))}, time_s[keep])
    kept = replace(readings, time_s=time_s[keep], world_from_sensor=readings.world_from_sensor[keep])
    return kept, notes


def _largest_chain(
    points: FloatArray, time_s: FloatArray, starts: IntArray, ends: IntArray
) -> BoolArray | None:
    """Which poses are in the pieces, between jumps, that follow each other within reach and hold the most."""
    if starts.size > _MOST_PIECES:
        return None
    sizes = (ends - starts + 1).astype(float)
    # A tool that is lost is often written as the identity: such pieces count for nothing.
    lost = _apart(points, _points(RigidTransform.identity(1))) == 0
    sizes[[bool(lost[a : b + 1].all()) for a, b in zip(starts, ends, strict=True)]] = 0.0
    best, before = sizes.copy(), np.full(starts.size, -1)
    for k in range(1, starts.size):
        apart = _apart(points[starts[k]], points[ends[:k]])
        within = np.flatnonzero(apart <= _reach(time_s[starts[k]] - time_s[ends[:k]]))
        if within.size:
            i = int(within[np.argmax(best[within])])
            best[k], before[k] = best[i] + sizes[k], i
    keep, k = np.zeros(len(points), dtype=bool), int(np.argmax(best))
    while k >= 0:
        keep[starts[k] : ends[k] + 1] = sizes[k] > 0
        k = int(before[k])
    return keep


def _points(poses: RigidTransform) -> FloatArray:
    """The sensor's origin and three points beside it, shape (m, 4, 3)."""
    matrices = poses.as_matrix()
    around = matrices[:, None, :3, 3] + _LEVER_MM * matrices[:, :3, :3].transpose(0, 2, 1)
    return np.concatenate([matrices[:, None, :3, 3], around], axis=1)


def _apart(points: FloatArray, others: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(points - others, axis=-1).max(axis=-1))


def _reach(time_s: FloatArray) -> FloatArray:
    return _SLACK_MM + _FASTEST_MM_S * time_s


def _repeats(readings: TimedPoses, frames: Frames, frame_time_s: FloatArray) -> list[str]:
    """Tell the longest run of one pose while images change."""
    matrices, time_s = readings.world_from_sensor.as_matrix(), readings.time_s
    changes = np.flatnonzero((matrices[1:] != matrices[:-1]).any(axis=(1, 2))) + 1
    starts, stops = np.r_[0, changes], np.r_[changes, len(readings)]
    lengths = stops - starts
    odd = lengths > max(_MOST_ALIKE, _MOST_TIMES * float(np.median(lengths)))
    if changes.size == 0 or not odd.any():
        return []
    k = int(np.argmax(lengths))
    first_s, last_s = time_s[starts[k]], time_s[stops[k] - 1]
    inside = np.flatnonzero((frame_time_s >= first_s) & (frame_time_s <= last_s))
    if inside.size < 2 or np.array_equal(frames[int(inside[0])], frames[int(inside[-1])]):
        return []
    return [
        f"poses: {np.count_nonzero(odd)} run(s) of one pose while images change, the longest of {lengths[k]} "
        f"poses, {last_s - first_s:.3g} s from {first_s:.3f} s: the tracker's output stood still"
    ]
