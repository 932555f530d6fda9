"""Filter rows and poses of recordings: leave out invalid ones, with a note."""

from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.geometry import nearest_rotation
from speckle3d.core.streams import TimedPoses
from speckle3d.core.sweep import Sweep, Tracker

ROUNDING_TOLERANCE = 1e-3
"""How far a rotation's numbers may be from the nearest rotation's before it is made rigid. An electromagnetic
tracker that rounds its own output was measured at 2.3e-4; six written digits alone give 1e-6."""

_FASTEST_MM_S, _SLACK_MM = 300.0, 3.0
"""Of a point of the probe between two readings. The fastest path at hand, a motor's, has 255 mm/s, freehand
sweeps of PLUS have at most 28; a jump of 22 mm in 50 ms is beyond. The slack is a tracker's noise and uneven
time stamps."""

_FARTHEST_MM = 1e5
"""From a tracker's origin. NDI writes a lost tool at -3.7e28 mm."""

_LEVER_MM = 50.0
"""From the sensor to points whose displacement stands for a rotation: half a probe's length."""

_MOST_JUMPING = 0.2
"""Share of poses after jumps, above which these are no faults of readings but how the probe was placed."""

_MOST_ALIKE, _MOST_TIMES = 3, 3
"""Poses in a row that are the same to the last digit: a tracker's noise alone changes them, and 2 of 5,000 at
hand are alike. Of a tracker slower than the images, runs are regular: three times their median is odd."""

_LEAST_OF_WIDTH = 1 / 200
"""Length of a path as a share of the image's width, below which it is in metres or stands still."""


def rising(times: FloatArray) -> IntArray:
    """Indices of the longest strictly increasing part of `times`, shape (n,); NaN is left out.

    Of equal times the first one stays (patience sorting).
    """
    tails, last, before = list[float](), list[int](), dict[int, int]()
    for i in np.flatnonzero(np.isfinite(times)).tolist():
        place = bisect_left(tails, times[i])
        if place == len(tails) or times[i] < tails[place]:
            before[i] = last[place - 1] if place else -1
            tails[place : place + 1], last[place : place + 1] = [times[i]], [i]
    rows, i = list[int](), last[-1] if last else -1
    while i >= 0:
        rows.append(i)
        i = before[i]
    return np.array(rows[::-1], dtype=int)


def usable(noun: str, time_s: FloatArray, faults: Sequence[str] | None = None) -> tuple[IntArray, list[str]]:
    """Choose the valid rows of a recording, with a note of those left out.

    Parameters
    ----------
    noun : str
        What a row is, as "poses".
    time_s : ndarray, shape (n,)
        NaN where a row has none.
    faults : sequence of str, length n, optional
        Why a row is of no use, as "without a valid pose"; empty where it is.

    Returns
    -------
    rows : ndarray of int
    notes : list of str
        A line where rows are left out.
    """
    reasons = np.array(faults or [""] * time_s.size, dtype=object)
    reasons[(reasons == "") & ~np.isfinite(time_s)] = "without a time"
    rows = rising(np.where(reasons == "", time_s, np.nan))
    late = np.setdiff1d(np.flatnonzero(reasons == ""), rows)
    is_repeat = np.isin(time_s[late], time_s[rows])
    reasons[late] = np.where(is_repeat, "with a repeated time", "with a time out of order")
    return rows, _loss(noun, time_s.size, Counter(filter(None, reasons)), time_s[rows])


def tracker_of(
    time_s: FloatArray, matrices: FloatArray, mounting: RigidTransform | None = None
) -> tuple[Tracker | None, list[str]]:
    """Tracker of usable poses, shape (n, 4, 4), mm, NaN where there is none; and a line of the others.

    Rotations that are rounded are made exact.
    """
    is_near = (np.abs(matrices) < _FARTHEST_MM).all(axis=(1, 2))
    exact = RigidTransform.identity(len(matrices)).as_matrix()
    exact[is_near, :3, 3] = matrices[is_near, :3, 3]
    exact[is_near, :3, :3] = nearest_rotation(matrices[is_near, :3, :3])
    is_rigid = (np.abs(exact - matrices) < ROUNDING_TOLERANCE).all(axis=(1, 2))
    faults = np.where(
        is_near, np.where(is_rigid, "", "whose pose is not rigid"), "whose pose is not within 100 m"
    )
    faults[np.isnan(matrices).any(axis=(1, 2))] = "without a valid pose"
    rows, notes = usable("poses", time_s, faults.tolist())
    if not rows.size:
        return None, notes
    poses = TimedPoses(time_s[rows], RigidTransform.from_matrix(exact[rows]))
    return Tracker(poses, mounting), notes


def _loss(noun: str, total: int, reasons: Mapping[str, int], time_s: FloatArray) -> list[str]:
    """Tell how many rows are left out and why, and the longest gap between those that stay."""
    if not reasons:
        return []
    counts = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
    text = f"{noun}: {sum(reasons.values())} of {total} left out ({counts})"
    if time_s.size > 1:
        i = int(np.argmax(np.diff(time_s)))
        text += f"; the longest gap is {time_s[i + 1] - time_s[i]:.3g} s, after {time_s[i]:.3f} s"
    return [text]


def checked_path(sweep: Sweep, chain: str) -> tuple[Sweep, list[str]]:
    """Remove jumps from a sweep's tracker, with notes on its path and matching poses.

    Parameters
    ----------
    chain : str
        Where the poses are from, as ``ImageToProbe * ProbeToTracker``.
    """
    tracker = sweep.tracker
    if tracker is None:
        return sweep, []
    readings, notes = without_jumps(tracker.readings)
    times = sweep.frame_time_s - tracker.time_offset_s
    reach = readings.covers(times)
    between = np.count_nonzero(reach & ~np.isin(times, readings.time_s))
    notes += _repeats(readings, sweep, times)
    extent = float(np.linalg.norm(np.ptp(readings.world_from_sensor.translation, axis=0)))
    width = sweep.grid.width_mm
    if len(readings) > 1 and extent < _LEAST_OF_WIDTH * width:
        notes.append(
            f"poses: the path spans {extent:.3g} mm and the image is {width:.4g} mm wide: the probe stood "
            "still, or the poses are in metres"
        )
    notes.append(
        f"poses of {chain}, mm: {len(readings)} poses, {len(sweep)} images, {np.count_nonzero(reach)} "
        "matched" + (f", {between} of them between two poses" if between else "")
    )
    return replace(sweep, tracker=replace(tracker, readings=readings)), notes


def without_jumps(readings: TimedPoses) -> tuple[TimedPoses, list[str]]:
    """Keep the largest part of a path in which a hand reaches each pose from the one before.

    Where that leaves out more than a fifth of what a tool in sight can have, poses are single placements and
    not a path: all stay.
    """
    poses, time_s, numbers = readings.world_from_sensor, readings.time_s, np.arange(len(readings))

    def step_mm(i: IntArray, k: IntArray) -> FloatArray:
        motion = poses[i].inv() * poses[k]
        shift_mm = np.linalg.norm(motion.translation, axis=-1)
        return np.asarray(np.maximum(shift_mm, _LEVER_MM * motion.rotation.magnitude()))

    def is_jump(i: IntArray, k: IntArray) -> BoolArray:
        return step_mm(i, k) > _SLACK_MM + _FASTEST_MM_S * (time_s[k] - time_s[i])

    jumps = numbers[1:][is_jump(numbers[:-1], numbers[1:])]
    if not jumps.size:
        return readings, []
    # Places of a lost tool, one again and again, count for nothing.
    _, places, counts = np.unique(poses.as_matrix(), axis=0, return_inverse=True, return_counts=True)
    pieces, places = np.split(numbers, jumps), places.ravel()
    pieces = [piece for piece in pieces if np.ptp(places[piece]) or counts[places[piece[0]]] == 1] or pieces
    largest = int(np.argmax([piece.size for piece in pieces]))
    rows = pieces[largest]
    for piece in (*pieces[largest + 1 :], *pieces[:largest][::-1]):
        before, after = (rows, piece) if rows[-1] < piece[0] else (piece, rows)
        rows = rows if is_jump(before[-1:], after[:1]) else np.concatenate([before, after])
    first = jumps[:1]
    length_mm, took_s = step_mm(first - 1, first)[0], np.diff(time_s)[first - 1][0]
    jump = f"{length_mm:.3g} mm in {1e3 * took_s:.3g} ms at {time_s[first][0]:.3f} s"
    if rows.size < (1.0 - _MOST_JUMPING) * sum(piece.size for piece in pieces):
        return readings, [f"poses: {jumps.size} jumps that no hand makes, as {jump}: all are kept"]
    reasons = {f"after jumps, as {jump}": len(readings) - rows.size}
    notes = _loss("poses", len(readings), reasons, time_s[rows])
    return replace(readings, time_s=time_s[rows], world_from_sensor=poses[rows]), notes


def _repeats(readings: TimedPoses, sweep: Sweep, frame_time_s: FloatArray) -> list[str]:
    """Tell the longest run of one pose while images change."""
    matrices = readings.world_from_sensor.as_matrix()
    changes = np.flatnonzero((matrices[1:] != matrices[:-1]).any(axis=(1, 2))) + 1
    runs = np.split(readings.time_s, changes)
    longest, usual = max(runs, key=len), float(np.median([run.size for run in runs]))
    inside = np.flatnonzero((frame_time_s >= longest[0]) & (frame_time_s <= longest[-1]))
    if len(runs) == 1 or longest.size <= max(_MOST_ALIKE, _MOST_TIMES * usual) or inside.size < 2:
        return []
    first, last = (sweep.frames[int(i)] for i in inside[[0, -1]])
    if np.array_equal(first, last):
        return []
    return [
        f"poses: runs of one pose while images change, the longest of {longest.size} poses, "
        f"{np.ptp(longest):.3g} s from {longest[0]:.3f} s: the tracker's output stood still"
    ]
