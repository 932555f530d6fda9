"""Calibrate from a recording of a phantom: join images and readings by the clock."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calibration.beam import BeamBias
from calibration.clock.fitted import estimate_offset, with_uncertain_offset
from calibration.clock.offset import ClockOffset, covered
from calibration.consensus import GATES_MM, Consensus, find_consensus
from calibration.points import Detections, ImagePoints, Recording
from calibration.report import as_calibration
from calibration.solution import Solution
from speckle3d.core.calibration import Calibration, FramesUsed
from speckle3d.core.errors import InsufficientDataError

SEARCH_S = 0.4
"""Clock offsets tried to either side of the recording's own: usual latencies of trackers and frame grabbers
are below 0.2 s."""
CHOICE_STEP_S = 0.1
"""Clock offsets at which crossings are chosen; a hand moves by a few millimetres in that time."""
_LEAST_COVERAGE = 0.3
"""Least share of the frames with a detection that must have a reading; below it, the recordings do not belong
together."""
_UNREAD = "no sensor reading at its time"


@dataclass(frozen=True)
class Outcome:
    """A calibration with the contents of its report.

    Attributes
    ----------
    detections : Detections
        What it is made from; of several candidates in a frame, the one that agrees with the other frames.
    """

    solution: Solution
    calibration: Calibration
    detections: Detections
    recording: Recording
    beam: tuple[BeamBias, ...] = ()
    offset: ClockOffset | None = None


def calibrate_recording(
    recording: Recording,
    detections: Detections,
    method: str,
    calibrate: Callable[[ImagePoints], Solution],
    time_offset_s: float | Literal["estimate"] | None = None,
) -> Outcome:
    """Calibrate from the detections in a recording.

    Parameters
    ----------
    calibrate : callable
        Calibrates with points; called again and again where the clock's offset is estimated.
    time_offset_s : float or "estimate", optional
        In place of the recording's own; or the one that explains the images best, near the recording's.

    Raises
    ------
    InsufficientDataError
        If nothing was detected, few frames have a reading, or `calibrate` refuses.
    """
    if len(detections.frame) == 0:
        reason = min(detections.dropped.values(), default="no frames")
        raise InsufficientDataError(f"expected the phantom in the images, got it in none: {reason}")
    offset_s = time_offset_s if isinstance(time_offset_s, float) else recording.time_offset_s
    offset, (points, reasons) = None, with_poses(recording, detections, offset_s)
    if time_offset_s == "estimate":
        offset = estimate_offset(calibrate, points, recording.readings, offset_s, SEARCH_S)
        offset_s = offset.seconds
        points, reasons = with_poses(recording, detections, offset_s)
    solution = calibrate(points)
    if offset is not None:
        solution = with_uncertain_offset(solution, points, recording.readings, offset_s)
    frames = FramesUsed(recording.images.shape[0], (), reasons)
    has_offset = time_offset_s is not None or offset_s != 0.0
    calibration = as_calibration(solution, method, frames, offset_s if has_offset else None)
    return Outcome(solution, calibration, detections, recording, offset=offset)


def with_poses(
    recording: Recording, detections: Detections, offset_s: float
) -> tuple[ImagePoints, dict[int, str]]:
    """Join detections with the sensor's poses at the same time, by a clock that is off by `offset_s`.

    Returns
    -------
    points : ImagePoints
        Of the frames with a reading.
    reasons : dict of int to str
        Why other frames have none: `Detections.dropped`, and those without a reading.

    Raises
    ------
    InsufficientDataError
        If few frames have one.
    """
    times = recording.frame_time_s[detections.frame]
    with_reading = covered(recording.readings, times, offset_s)
    if with_reading.sum() < max(1.0, _LEAST_COVERAGE * len(times)):
        first, last = recording.readings.time_s[[0, -1]] + offset_s
        raise InsufficientDataError(
            f"expected sensor readings at the times of the frames, got them for {with_reading.sum()} of "
            f"{len(times)} in which something was found: readings span {first:.3f} to {last:.3f} s, frames "
            f"{recording.frame_time_s[0]:.3f} to {recording.frame_time_s[-1]:.3f} s"
        )
    missing = dict.fromkeys((int(n) for n in np.unique(detections.frame[~with_reading])), _UNREAD)
    poses = recording.world_from_sensor(detections.frame[with_reading], offset_s)
    below_origin = replace(detections, pixels=detections.pixels + recording.first_px)
    return below_origin[with_reading].points(poses, times[with_reading]), {**detections.dropped, **missing}


def choose_crossings(recording: Recording, detections: Detections, offsets_s: Sequence[float]) -> Detections:
    """Choose the candidate of each frame that is where the other frames put the crossing.

    Parameters
    ----------
    detections : Detections
        One or several candidates in each frame; what has one only is returned as it is.
    offsets_s : sequence of float
        Clock offsets tried, at least one; the one with which most frames agree counts.

    Raises
    ------
    InsufficientDataError
        If no more frames agree than chance candidates would, or few have a sensor reading.
    """
    if len(detections) == len(np.unique(detections.frame)):
        return detections
    trials: list[tuple[Consensus, dict[int, str]]] = []
    for offset_s in offsets_s:
        points, reasons = with_poses(recording, detections, offset_s)
        trials.append((find_consensus(points, recording.pixel_mm), reasons))
    consensus, reasons = min(trials, key=lambda trial: trial[0].false_alarms)
    candidates = detections[~np.isin(detections.frame, list(reasons))]
    near = consensus.require().away_mm <= GATES_MM[-1]
    elsewhere = f"nothing within {GATES_MM[-1]:g} mm of the other frames' crossing"
    reasons |= dict.fromkeys((int(n) for n in candidates.frame[consensus.choice[~near]]), elsewhere)
    return replace(candidates[consensus.choice[near]], dropped=reasons)
