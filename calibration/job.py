"""From a recording of a phantom to a calibration with what its report shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.beam import BeamBias, predict_bias
from calibration.chain import ChainSolution, ImagePoints, Seen, as_directions
from calibration.clock.fitted import estimate_offset
from calibration.clock.offset import ClockOffset, covered
from calibration.clock.smoothing import smooth
from calibration.detection.dots import dots_in_frames, single_dots
from calibration.detection.labelling import label_dots
from calibration.nwires import label_and_start
from calibration.orientation import Viewed, calibrate_orientation
from calibration.plane import Stages, calibrate_plane
from calibration.report import Shot, as_calibration
from calibration.solver import OUTLIER_SIGMA
from calibration.wires import Registration, calibrate_cross_wire, calibrate_wires
from speckle3d.core.arrays import FloatArray
from speckle3d.core.calibration import Calibration, FramesUsed
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import Frames
from speckle3d.core.wires import WirePhantom

Progress = Callable[[int, int], None]

SEARCH_S = 0.4
"""Clock offsets tried to either side of the recording's own: usual latencies of trackers and frame grabbers
are below 0.2 s."""

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
    """A calibration and what its report shows."""

    solution: ChainSolution
    calibration: Calibration
    shots: tuple[Shot, ...]
    beam: tuple[BeamBias, ...] = ()
    offset: ClockOffset | None = None


def find_crossings(
    recording: Recording, region_px: npt.ArrayLike | None = None, progress: Progress | None = None
) -> Seen:
    """Find in every image the bright dot that a crossing of wires, or a bead, makes."""
    return single_dots(dots_in_frames(recording.images, recording.pixel_mm, None, region_px, progress))


def find_nwires(
    recording: Recording,
    phantom: WirePhantom,
    region_px: npt.ArrayLike | None = None,
    progress: Progress | None = None,
) -> Seen:
    """Find the dots of an N-wire phantom and the wires they show.

    Where every frame has a sensor reading, a calibration from the frames that show all wires then finds
    those of the other frames.
    """
    dots = dots_in_frames(recording.images, recording.pixel_mm, None, region_px, progress)
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
) -> Outcome:
    """Calibrate a 6-DOF sensor with a plane; `beam_mm` are thicknesses whose bias the report shows."""
    _require_poses(recording)
    outcome = _finished(
        recording,
        seen,
        job,
        lambda points: calibrate_plane(points, recording.pixel_mm, fit_pixels, stages, job.outlier_sigma),
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
        )

    return _finished(recording, seen, job, calibrate, "orientation")


def wires_job(
    recording: Recording,
    seen: Seen,
    job: JobSettings,
    phantom: WirePhantom | None,
    fit_pixels: bool = True,
    registration: Registration = "turned",
) -> Outcome:
    """Calibrate a 6-DOF sensor with three orthogonal wires or N-shapes; without a phantom, two that cross."""
    _require_poses(recording)
    known = recording.pixel_mm, fit_pixels

    def calibrate(points: ImagePoints) -> ChainSolution:
        if phantom is None:
            return calibrate_cross_wire(points, *known, job.outlier_sigma)
        return calibrate_wires(points, phantom, *known, registration, job.outlier_sigma)

    method = "cross-wire" if phantom is None else "n-wire" if phantom.n_shapes else "three-wire"
    return _finished(recording, seen, job, calibrate, method)


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
) -> Outcome:
    if len(seen.frame) == 0:
        reasons = sorted(set(seen.dropped.values())) or ["no frames"]
        raise InsufficientDataError(f"expected the phantom in the images, got it in none: {reasons[0]}")
    offset = None
    if job.estimate_offset:
        timed = _covered_throughout(recording, seen)
        steady = replace(recording, readings=smooth(recording.readings))
        offset = estimate_offset(
            calibrate,
            lambda offset_s: paired(steady, timed, offset_s)[0],
            recording.time_offset_s,
            SEARCH_S,
        )
    used_offset = recording.time_offset_s if offset is None else offset.seconds
    points, dropped = paired(recording, seen, used_offset)
    solution = calibrate(points)
    frames = FramesUsed(recording.images.shape[0], (), dropped)
    known = offset is not None or job.offset_given or recording.time_offset_s != 0.0
    calibration = as_calibration(solution, method, frames, used_offset if known else None)
    return Outcome(solution, calibration, _shots(recording, seen, calibration), offset=offset)


def _covered_throughout(recording: Recording, seen: Seen) -> Seen:
    """Those frames that have a reading at every offset tried: all offsets are judged by the same frames."""
    there = covered(recording.readings, recording.frame_time_s[seen.frame], recording.time_offset_s, SEARCH_S)
    if not there.any():
        raise InsufficientDataError(
            f"expected readings from {SEARCH_S:g} s before to {SEARCH_S:g} s after some frames, to tell the "
            "clock, got none"
        )
    return seen[there]


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
