"""From a recording of a phantom to a calibration: images and readings joined by the clock."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calibration.beam import BeamBias
from calibration.clock.fitted import estimate_offset, with_uncertain_offset
from calibration.clock.offset import ClockOffset, covered
from calibration.consensus import GATES_MM, Consensus, find_consensus
from calibration.points import ImagePoints, Recording, Seen
from calibration.report import Shot, as_calibration
from calibration.solution import Solution
from speckle3d.core.calibration import Calibration, FramesUsed
from speckle3d.core.errors import InsufficientDataError

SEARCH_S = 0.4
"""Clock offsets tried to either side of the recording's own: usual latencies of trackers and frame grabbers
are below 0.2 s."""
CHOICE_STEP_S = 0.1
"""Clock offsets at which crossings are chosen; a hand moves by a few millimetres in that time."""
_FEWEST_COVERED = 0.3
"""Least share of the frames with a detection that must have a reading; below it, the recordings do not belong
together."""
_UNREAD = "no sensor reading at its time"


@dataclass(frozen=True)
class Outcome:
    """A calibration and what its report shows.

    Attributes
    ----------
    seen : Seen
        What it is made from; of several candidates, those chosen.
    """

    solution: Solution
    calibration: Calibration
    seen: Seen
    shots: tuple[Shot, ...]
    beam: tuple[BeamBias, ...] = ()
    offset: ClockOffset | None = None


def calibrate_recording(
    recording: Recording,
    seen: Seen,
    method: str,
    calibrate: Callable[[ImagePoints], Solution],
    time_offset_s: float | Literal["estimate"] | None = None,
    with_clock: Callable[[ImagePoints], Solution] | None = None,
) -> Outcome:
    """Calibrate with what was seen in a recording.

    Parameters
    ----------
    calibrate : callable
        Calibrates with points; called again and again where the clock's offset is estimated.
    time_offset_s : float or "estimate", optional
        In place of the recording's own; or the one that explains the images best, near the recording's.
    with_clock : callable, optional
        Calibrates once the offset is known; by default `calibrate`.

    Raises
    ------
    InsufficientDataError
        If nothing was seen, few frames have a reading, or `calibrate` refuses.
    """
    if len(seen.frame) == 0:
        reasons = sorted(set(seen.dropped.values())) or ["no frames"]
        raise InsufficientDataError(f"expected the phantom in the images, got it in none: {reasons[0]}")
    offset_s = time_offset_s if isinstance(time_offset_s, float) else recording.time_offset_s
    offset, (points, dropped) = None, paired(recording, seen, offset_s)
    if time_offset_s == "estimate":
        offset = estimate_offset(calibrate, points, recording.readings, offset_s, SEARCH_S)
        offset_s = offset.seconds
        points, dropped = paired(recording, seen, offset_s)
    solution = (with_clock or calibrate)(points)
    if offset is not None:
        solution = with_uncertain_offset(solution, points, recording.readings, offset_s)
    frames = FramesUsed(recording.images.shape[0], (), dropped)
    stated = time_offset_s is not None or offset_s != 0.0
    calibration = as_calibration(solution, method, frames, offset_s if stated else None)
    return Outcome(solution, calibration, seen, _shots(recording, seen, calibration), offset=offset)


def paired(recording: Recording, seen: Seen, offset_s: float) -> tuple[ImagePoints, dict[int, str]]:
    """Join what was seen with the readings at the same time, by a clock that is off by `offset_s`.

    Returns
    -------
    points : ImagePoints
        Of the frames with a reading.
    dropped : dict of int to str
        Why other frames have none: `Seen.dropped`, and those without a reading.

    Raises
    ------
    InsufficientDataError
        If few frames have one.
    """
    times = recording.frame_time_s[seen.frame]
    with_reading = covered(recording.readings, times, offset_s)
    if with_reading.sum() < max(1.0, _FEWEST_COVERED * len(times)):
        first, last = recording.readings.time_s[[0, -1]] + offset_s
        raise InsufficientDataError(
            f"expected sensor readings at the times of the frames, got them for {with_reading.sum()} of "
            f"{len(times)} in which something was found: readings span {first:.3f} to {last:.3f} s, frames "
            f"{recording.frame_time_s[0]:.3f} to {recording.frame_time_s[-1]:.3f} s"
        )
    missing = dict.fromkeys((int(n) for n in np.unique(seen.frame[~with_reading])), _UNREAD)
    poses = recording.world_from_sensor(seen.frame[with_reading], offset_s)
    below_origin = replace(seen, pixels=seen.pixels + recording.first_px)
    return below_origin[with_reading].points(poses, times[with_reading]), {**seen.dropped, **missing}


def choose_crossings(recording: Recording, seen: Seen, offsets_s: Sequence[float]) -> Seen:
    """Choose the candidate of each frame that is where the other frames put the crossing.

    Parameters
    ----------
    seen : Seen
        One or several candidates in each frame; what has one only is returned as it is.
    offsets_s : sequence of float
        Clock offsets tried, at least one; the one with which most frames agree counts.

    Raises
    ------
    InsufficientDataError
        If no more frames agree than chance candidates would, or few have a sensor reading.
    """
    if len(seen) == len(np.unique(seen.frame)):
        return seen
    tried: list[tuple[Consensus, Seen]] = []
    for offset_s in offsets_s:
        with_reading = covered(recording.readings, recording.frame_time_s[seen.frame], offset_s)
        consensus = find_consensus(paired(recording, seen, offset_s)[0], recording.pixel_mm)
        tried.append((consensus, seen[with_reading]))
    consensus, candidates = min(tried, key=lambda one: one[0].false_alarms)
    near = consensus.require().away_mm <= GATES_MM[-1]
    elsewhere = f"nothing within {GATES_MM[-1]:g} mm of the other frames' crossing"
    reasons = dict.fromkeys((int(n) for n in candidates.frame[consensus.nearest[~near]]), elsewhere)
    unread = np.setdiff1d(seen.frame, candidates.frame)
    reasons |= dict.fromkeys((int(n) for n in unread), _UNREAD)
    return replace(candidates[consensus.nearest[near]], dropped={**seen.dropped, **reasons})


def _shots(recording: Recording, seen: Seen, calibration: Calibration) -> tuple[Shot, ...]:
    """A used frame from the middle, one from the end, and the first that was dropped."""
    used, dropped = calibration.frames.used, calibration.frames.dropped
    chosen = [used[len(used) // 2], used[-1], *sorted(dropped)[:1]]
    return tuple(
        Shot(
            number,
            recording.images[number],
            seen.pixels[seen.frame == number].reshape(-1, 2),
            seen.are_lines,
            dropped.get(number, ""),
        )
        for number in dict.fromkeys(chosen)
    )
