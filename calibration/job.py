"""From a recording of a phantom to a calibration with what its report shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.beam import BeamBias, predict_bias
from calibration.chain import ChainSolution, ImagePoints, Seen, as_directions
from calibration.clock.fitted import estimate_offset, with_uncertain_offset
from calibration.clock.offset import ClockOffset, covered, delays_around
from calibration.consensus import GATES_MM, Consensus, find_consensus
from calibration.detection.crossings import crossings_in_frames
from calibration.detection.dots import dots_in_frames
from calibration.detection.labelling import label_dots
from calibration.nwires import label_and_start
from calibration.orientation import Viewed, calibrate_orientation
from calibration.plane import PIXEL_ERROR, Stages, calibrate_plane
from calibration.registration import Choice, calibrate_registered
from calibration.report import Shot, as_calibration
from calibration.solver import OUTLIER_SIGMA
from calibration.wires import BESIDE_MM, Registration, calibrate_cross_wire, calibrate_wires
from speckle3d.core.arrays import FloatArray
from speckle3d.core.calibration import Calibration, FramesUsed
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.progress import Progress
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import Frames
from speckle3d.core.wires import WirePhantom

SEARCH_S = 0.4
"""Clock offsets tried to either side of the recording's own: usual latencies of trackers and frame grabbers
are below 0.2 s."""

_CHOICE_STEP_S = 0.1
"""Clock offsets at which crossings are chosen; a hand moves by a few millimetres in that time."""

_FEWEST_COVERED = 0.3
"""Least share of the frames with a detection that must have a reading; below it, the recordings do not belong
together."""


@dataclass(frozen=True)
class Recording:
    """Images of a phantom and a sensor's readings.

    Parameters
    ----------
    images : Frames, shape (n, column, row)
        Grey levels.
    pixel_mm : ndarray, shape (2,)
        Distance between columns and between rows; rough where it is to be estimated.
    first_row : float
        Depth of row 0 below the image's origin, in rows.
    frame_time_s : ndarray, shape (n,)
    readings : TimedPoses or TimedRotations
    time_offset_s : float
        A reading at t belongs to image time t + `time_offset_s`.
    """

    images: Frames
    pixel_mm: FloatArray
    first_row: float
    frame_time_s: FloatArray
    readings: TimedPoses | TimedRotations
    time_offset_s: float = 0.0


class JobSettings(BaseModel):
    """What to do with the sensor's clock and with frames that contradict the others."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    estimate_offset: bool = Field(
        False, description="Find the clock offset that explains the images best, near the recording's own."
    )
    offset_given: bool = Field(
        False,
        description="The recording's clock offset was given: it is saved with the calibration even if zero.",
    )
    outlier_sigma: float = Field(
        OUTLIER_SIGMA, gt=0, description="Drop frames whose residual exceeds so many standard deviations."
    )


@dataclass(frozen=True)
class Outcome:
    """A calibration and what its report shows.

    Attributes
    ----------
    seen : Seen
        What it is made from; of several candidates, those chosen.
    """

    solution: ChainSolution
    calibration: Calibration
    seen: Seen
    shots: tuple[Shot, ...]
    beam: tuple[BeamBias, ...] = ()
    offset: ClockOffset | None = None
    choice: Choice | None = None


def find_crossings(
    recording: Recording, region_px: npt.ArrayLike | None = None, progress: Progress | None = None
) -> Seen:
    """Find in every image places where wires may cross, or a bead may be; `wires_job` chooses among them."""
    return crossings_in_frames(recording.images, recording.pixel_mm, None, region_px, progress)


def choose_crossings(recording: Recording, seen: Seen, offsets_s: Sequence[float]) -> Seen:
    """Choose the candidate of each frame that is where the other frames put the crossing.

    Parameters
    ----------
    seen : Seen
        One or several candidates in each frame; what has one only is returned as it is.
    offsets_s : sequence of float
        Clock offsets tried; the one with which most frames agree counts.

    Raises
    ------
    InsufficientDataError
        If no more frames agree than chance candidates would, or few have a sensor reading.
    """
    if len(seen) == len(np.unique(seen.frame)):
        return seen
    best: tuple[Consensus, Seen] | None = None
    for offset_s in offsets_s:
        there = covered(recording.readings, recording.frame_time_s[seen.frame], offset_s)
        found = find_consensus(paired(recording, seen, offset_s)[0], recording.pixel_mm)
        if best is None or found.false_alarms < best[0].false_alarms:
            best = found, seen[there]
    if best is None:
        raise InvalidInputError("offsets_s: expected at least one, got none")
    found, candidates = best[0].require(), best[1]
    near = found.away_mm <= GATES_MM[-1]
    elsewhere = f"nothing within {GATES_MM[-1]:g} mm of the other frames' crossing"
    reasons = dict.fromkeys((int(n) for n in candidates.frame[found.nearest[~near]]), elsewhere)
    unread = np.setdiff1d(seen.frame, candidates.frame)
    reasons |= dict.fromkeys((int(n) for n in unread), "no sensor reading at its time")
    chosen = candidates[found.nearest[near]]
    return replace(chosen, dropped={**seen.dropped, **reasons})


def find_nwires(
    recording: Recording,
    phantom: WirePhantom,
    region_px: npt.ArrayLike | None = None,
    progress: Progress | None = None,
    leave_out: Sequence[int] = (),
) -> Seen:
    """Find the dots of an N-wire phantom and the wires they show, but for frames that are left out.

    Where every frame has a sensor reading, a calibration from the frames that show all wires then finds
    those of the other frames.
    """
    dots = dots_in_frames(recording.images, recording.pixel_mm, None, region_px, progress).without(leave_out)
    times, offset_s = recording.frame_time_s, recording.time_offset_s
    everywhere = covered(recording.readings, times, offset_s).all()
    if isinstance(recording.readings, TimedPoses) and everywhere:
        poses = recording.readings.at(times - offset_s)
        return label_and_start(dots, phantom, poses, recording.pixel_mm)[0]
    return label_dots(dots, phantom, recording.pixel_mm)


def plane_job(
    recording: Recording,
    seen: Seen,
    job: JobSettings,
    fit_pixels: bool = True,
    stages: Stages = "three",
    beam_mm: Sequence[float] = (),
    pixel_error: float = PIXEL_ERROR,
) -> Outcome:
    """Calibrate a 6-DOF sensor with a plane; `beam_mm` are thicknesses whose bias the report shows."""
    _require_poses(recording)
    size = recording.pixel_mm
    outcome = _finished(
        recording,
        seen,
        job,
        lambda points: calibrate_plane(points, size, fit_pixels, stages, job.outlier_sigma, pixel_error),
        "plane",
    )
    return replace(outcome, beam=tuple(predict_bias(outcome.solution, width) for width in beam_mm))


def orientation_job(
    recording: Recording, seen: Seen, job: JobSettings, level: bool = False, viewed_from: Viewed = "above"
) -> Outcome:
    """Calibrate an orientation sensor with a plane."""

    def calibrate(points: ImagePoints) -> ChainSolution:
        lines = as_directions(points)
        return calibrate_orientation(
            lines.pixels,
            lines.frame,
            lines.world_from_sensor.rotation,
            recording.pixel_mm,
            level,
            viewed_from,
            job.outlier_sigma,
            lines.time_s,
        )

    return _finished(recording, seen, job, calibrate, "orientation")


def wires_job(
    recording: Recording,
    seen: Seen,
    job: JobSettings,
    phantom: WirePhantom | None,
    fit_pixels: bool = True,
    registration: Registration | Literal["auto"] = "auto",
    beside_mm: float = BESIDE_MM,
) -> Outcome:
    """Calibrate a 6-DOF sensor with three orthogonal wires or N-shapes; without a phantom, two that cross.

    With `registration` "auto", frames left out choose how much to believe of the stated place. A hand
    misses a crossing by `beside_mm`, out of plane.
    """
    _require_poses(recording)
    known = recording.pixel_mm, fit_pixels
    chosen = registration == "auto" and phantom is not None and phantom.world_from_phantom is not None
    # The clock is sought, before the choice, with what depends least on the place and yet is determined.
    fixed: Registration = "turned" if registration == "auto" else registration
    choices: list[Choice] = []

    def calibrate(points: ImagePoints) -> ChainSolution:
        if phantom is None:
            return calibrate_cross_wire(points, *known, job.outlier_sigma, beside_mm)
        return calibrate_wires(points, phantom, *known, fixed, job.outlier_sigma)

    def choose(points: ImagePoints) -> ChainSolution:
        assert phantom is not None
        solution, choice = calibrate_registered(points, phantom, *known, job.outlier_sigma)
        choices.append(choice)
        return solution

    if phantom is not None:
        method = "n-wire" if phantom.n_shapes else "three-wire"
        outcome = _finished(recording, seen, job, calibrate, method, choose if chosen else calibrate)
        return replace(outcome, choice=choices[-1] if choices else None)
    around = recording.time_offset_s
    offsets = delays_around(around, SEARCH_S, _CHOICE_STEP_S).tolist() if job.estimate_offset else [around]
    picked = choose_crossings(recording, seen, offsets) if len(seen) else seen
    outcome = _finished(recording, picked, job, calibrate, "cross-wire")
    shots = tuple(
        replace(shot, candidates_px=seen.pixels[seen.frame == shot.frame]) for shot in outcome.shots
    )
    return replace(outcome, shots=shots)


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
    there = covered(recording.readings, times, offset_s)
    if there.sum() < max(1.0, _FEWEST_COVERED * len(times)):
        first, last = recording.readings.time_s[[0, -1]] + offset_s
        raise InsufficientDataError(
            f"expected sensor readings at the times of the frames, got them for {there.sum()} of "
            f"{len(times)} in which something was found: readings span {first:.3f} to {last:.3f} s, frames "
            f"{recording.frame_time_s[0]:.3f} to {recording.frame_time_s[-1]:.3f} s"
        )
    missing = dict.fromkeys((int(n) for n in np.unique(seen.frame[~there])), "no sensor reading at its time")
    read: RigidTransform | Rotation = recording.readings.at(times[there] - offset_s)
    poses = RigidTransform.from_rotation(read) if isinstance(read, Rotation) else read
    below_origin = replace(seen, pixels=seen.pixels + np.array([0.0, recording.first_row]))
    return below_origin[there].points(poses, times[there]), {**seen.dropped, **missing}


def _finished(
    recording: Recording,
    seen: Seen,
    job: JobSettings,
    calibrate: Callable[[ImagePoints], ChainSolution],
    method: str,
    settle: Callable[[ImagePoints], ChainSolution] | None = None,
) -> Outcome:
    """Calibrate, with the clock's offset found first if asked for; `settle` calibrates once it is known."""
    if len(seen.frame) == 0:
        reasons = sorted(set(seen.dropped.values())) or ["no frames"]
        raise InsufficientDataError(f"expected the phantom in the images, got it in none: {reasons[0]}")
    points, dropped = paired(recording, seen, recording.time_offset_s)
    offset, used_offset = None, recording.time_offset_s
    if job.estimate_offset:
        offset = estimate_offset(calibrate, points, recording.readings, used_offset, SEARCH_S)
        used_offset = offset.seconds
        points, dropped = paired(recording, seen, used_offset)
    solution = (settle or calibrate)(points)
    if offset is not None:
        solution = with_uncertain_offset(solution, recording.readings, used_offset)
    frames = FramesUsed(recording.images.shape[0], (), dropped)
    known = offset is not None or job.offset_given or recording.time_offset_s != 0.0
    calibration = as_calibration(solution, method, frames, used_offset if known else None)
    return Outcome(solution, calibration, seen, _shots(recording, seen, calibration), offset=offset)


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


def _require_poses(recording: Recording) -> None:
    """Raise `InvalidInputError` unless the readings hold positions."""
    if not isinstance(recording.readings, TimedPoses):
        raise InvalidInputError(
            "expected a position sensor (tracker), got an orientation sensor: speckle3d calibrate orientation"
        )
