"""Calibration with a plane or wires, from recordings to what is written: the same for command and app."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration.beam import predict_bias
from calibration.clock.offset import covered, delays_around
from calibration.detection.crossings import crossings_in_frames
from calibration.detection.dots import dots_in_frames
from calibration.detection.labelling import label_dots
from calibration.detection.lines import detect_lines
from calibration.nwires import label_by_wires, nwire_errors_mm, trimmed_mean_mm
from calibration.orientation import calibrate_orientation
from calibration.plane import calibrate_plane
from calibration.points import Detections, ImagePoints, Recording
from calibration.recording import (
    CHOICE_STEP_S,
    SEARCH_S,
    Outcome,
    calibrate_recording,
    choose_crossings,
    with_poses,
)
from calibration.repeatability import validate
from calibration.report import figure_report
from calibration.wires import CROSSING, Wires, calibrate_cross_wire, calibrate_wires
from speckle3d.calibrating.recordings import open_recording
from speckle3d.calibrating.settings import (
    OrientationSettings,
    PlaneSettings,
    ScanSettings,
    WireSettings,
    command_line,
)
from speckle3d.calibrating.written import Written, write_with_report
from speckle3d.core.arrays import FloatArray
from speckle3d.core.calibration import readable
from speckle3d.core.errors import InvalidInputError, MismatchError, naming
from speckle3d.core.progress import Progress
from speckle3d.core.streams import TimedPoses
from speckle3d.core.wires import WirePhantom
from speckle3d.io.load import SIZED, kind_of
from speckle3d.io.plus.device_set import read_wire_phantom
from speckle3d.io.points import PickedPoints, read_points, write_points

BY_HAND = "left out by hand"
"""Why frames are dropped that the settings leave out."""

_BEAM_MM = (1.0, 2.0, 3.0)


@dataclass(frozen=True)
class WireSetup:
    """A phantom of wires, and what its configuration says of the images.

    Attributes
    ----------
    phantom : WirePhantom, optional
        None of wires that cross, whose geometry is not needed.
    pixel_mm : tuple of float, optional
        Column pitch and row spacing, roughly.
    clip_px : ndarray, shape (4, 2), optional
        The part of an image in which dots are looked for.
    is_detectable : bool
        Whether its dots can be found in the images; else they must be picked by hand.
    """

    phantom: WirePhantom | None = None
    pixel_mm: tuple[float, float] | None = None
    clip_px: FloatArray | None = None
    is_detectable: bool = True

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the wires, in order."""
        return () if self.phantom is None else self.phantom.names

    @classmethod
    def of(cls, phantom: str) -> WireSetup:
        """Look up a phantom: ``cross``, ``three``, or a configuration of PLUS.

        Raises
        ------
        FileError, InvalidInputError
            If it is none of these.
        """
        if phantom == "cross":
            return cls()
        if phantom == "three":
            return cls(three_wires(), is_detectable=False)
        config = read_wire_phantom(phantom)
        size = None if config.pixel_mm is None else (config.pixel_mm, config.pixel_mm)
        return cls(config.phantom, size, config.clip_px)


def open_phantom(images: Path, settings: ScanSettings) -> Recording:
    """Open a recording of a phantom; for errors see `open_recording`."""
    sensor = settings.sensor if isinstance(settings, OrientationSettings) else "tracker"
    pixel_mm = settings.pixel_mm
    if pixel_mm is None and isinstance(settings, WireSettings) and kind_of(images) not in SIZED:
        pixel_mm = WireSetup.of(settings.phantom).pixel_mm
    return open_recording(images, settings.poses, pixel_mm, sensor, settings.transform)


def detect_phantom(
    recording: Recording, settings: ScanSettings, progress: Progress | None = None
) -> Detections:
    """Find the phantom in every image, or read the points picked by hand; without the frames left out.

    Raises
    ------
    FileError, InvalidInputError
        If the region, the points or the frames left out do not fit the recording.
    """
    require_frames(settings, recording)
    if isinstance(settings, WireSettings):
        detections = _detect_wires(recording, settings, progress)
    else:
        assert isinstance(settings, PlaneSettings | OrientationSettings)
        region = settings.corners
        detections = detect_lines(recording.images, recording.pixel_mm, settings, region, progress)
    return detections.without(settings.frames_left_out, BY_HAND)


def require_frames(settings: ScanSettings, recording: Recording) -> None:
    """Raise `MismatchError` unless the frames left out are among the recording's."""
    frames, count = settings.frames_left_out, recording.images.shape[0]
    if frames and max(frames) >= count:
        raise MismatchError(f"--leave-out: expected frames from 0 to {count - 1}, got {max(frames)}")


def detections_by_hand(recording: Recording, points: PickedPoints, settings: ScanSettings) -> Detections:
    """Take points picked by hand, without the frames left out.

    Raises
    ------
    MismatchError
        If a point lies in no image of the recording.
    """
    points.require_inside(recording.images.shape)
    return Detections(points.frame, points.pixels, points.wire).without(settings.frames_left_out, BY_HAND)


def solve_phantom(recording: Recording, detections: Detections, settings: ScanSettings) -> Outcome:
    """Calibrate with what was found; for errors see `calibrate_recording`."""
    size, clock = recording.pixel_mm, settings.time_offset_s
    solve = partial(calibrate_recording, recording)
    if isinstance(settings, OrientationSettings):
        return solve(
            detections, "orientation", lambda points: calibrate_orientation(points, size, settings), clock
        )
    if not isinstance(recording.readings, TimedPoses):
        raise InvalidInputError(
            "expected a position sensor (tracker), got an orientation sensor: speckle3d calibrate orientation"
        )
    if isinstance(settings, PlaneSettings):
        outcome = solve(detections, "plane", lambda points: calibrate_plane(points, size, settings), clock)
        widths = () if settings.reflector == "bar" else settings.beam_mm or _BEAM_MM
        return replace(outcome, beam=tuple(predict_bias(outcome.solution, width) for width in widths))
    assert isinstance(settings, WireSettings)
    phantom = WireSetup.of(settings.phantom).phantom
    if phantom is None:
        offsets = [clock if isinstance(clock, float) else recording.time_offset_s]
        if clock == "estimate":
            offsets = delays_around(offsets[0], SEARCH_S, CHOICE_STEP_S).tolist()
        if len(detections):
            detections = choose_crossings(recording, detections, offsets)
        return solve(
            detections, "cross-wire", lambda points: calibrate_cross_wire(points, size, settings), clock
        )
    return solve(
        detections,
        "n-wire" if phantom.n_shapes else "three-wire",
        lambda points: calibrate_wires(points, phantom, size, settings),
        clock,
    )


def remarks(outcome: Outcome) -> list[str]:
    """Remarks of the report: the clock's offset, 3-D errors."""
    notes = _nwire_notes(outcome, outcome.solution.points)
    if (offset := outcome.offset) is not None:
        half_s = 1.96 * offset.standard_error_s
        notes.insert(0, f"clock offset {offset.seconds:+.4f} +- {half_s:.4f} s (95 %), estimated")
    return notes


def validation_notes(outcome: Outcome, settings: ScanSettings, progress: Progress | None) -> list[str]:
    """Check a calibration on the settings' other recording, if any, of which no frame is left out."""
    path = settings.validation
    if path is None:
        return []
    csv = getattr(settings, "validation_points", None)
    settings = settings.model_copy(update={"leave_out": "", "poses": None, "points": csv})
    recording = open_phantom(path, settings)
    with naming(str(path)):
        detections = detect_phantom(recording, settings, progress)
        seconds = outcome.calibration.time_offset_s
        offset_s = recording.time_offset_s if seconds is None else seconds
        if outcome.solution.phantom == CROSSING:
            detections = choose_crossings(recording, detections, [offset_s])
        points, _ = with_poses(recording, detections, offset_s)
        residuals = validate(outcome.solution, points)
    frames = len(points.frames)
    rms, unit = readable(float((residuals**2).mean() ** 0.5), outcome.calibration.rms_unit)
    notes = [f"on {path.name}, not used: RMS residual {rms} {unit}, {frames} frames, none left out"]
    return notes + [f"on {path.name}: {text}" for text in _nwire_notes(outcome, points)]


def write_outcome(
    outcome: Outcome,
    settings: ScanSettings,
    images: Path,
    out: Path,
    notes: Sequence[str],
) -> Written:
    """Write a calibration with its report, the settings that made it, and the dots it was made from."""
    dots = outcome.detections
    names = WireSetup.of(settings.phantom).names if isinstance(settings, WireSettings) else ()
    points = PickedPoints(dots.frame, dots.pixels, dots.wire)
    return write_with_report(
        outcome.calibration,
        [images],
        out,
        figure_report(outcome.solution, outcome.calibration, outcome.recording, dots),
        [*notes, f"made by: {command_line(settings, images, out)}"],
        outcome.beam,
        None if dots.are_lines else lambda path: write_points(path, points, names),
        settings.model_dump_json(exclude_defaults=True),
    )


def _detect_wires(recording: Recording, settings: WireSettings, progress: Progress | None) -> Detections:
    setup = WireSetup.of(settings.phantom)
    if settings.points is not None:
        points = read_points(settings.points, setup.names)
        with naming(str(settings.points)):
            return detections_by_hand(recording, points, settings)
    if not setup.is_detectable:
        raise InvalidInputError(
            f"--phantom {settings.phantom}: expected --points (of --validation: --validation-points), a CSV "
            "that says on which wire each dot lies, got none"
        )
    size, region = recording.pixel_mm, settings.corners
    if setup.phantom is None:
        return crossings_in_frames(recording.images, size, region, progress)
    clip: npt.ArrayLike | None = setup.clip_px if region is None else region
    dots = dots_in_frames(recording.images, size, clip, progress).without(settings.frames_left_out, BY_HAND)
    times, offset_s = recording.frame_time_s, recording.time_offset_s
    if isinstance(recording.readings, TimedPoses) and covered(recording.readings, times, offset_s).all():
        # A calibration from the frames that show all wires finds those of the other frames.
        return label_by_wires(dots, setup.phantom, recording.readings.at(times - offset_s), size)
    return label_dots(dots, setup.phantom, size)


def _nwire_notes(outcome: Outcome, points: ImagePoints) -> list[str]:
    """Report PLUS's 3-D error, if the phantom has N-shapes."""
    chain, phantom = outcome.solution.chain, outcome.solution.phantom
    if not isinstance(phantom, Wires) or not phantom.geometry.n_shapes:
        return []
    place = chain.target_from_world.inv()
    matrix = outcome.calibration.pixel_matrix()
    mean, sd = trimmed_mean_mm(nwire_errors_mm(points, phantom.geometry, matrix, place))
    return [f"3-D error of the middle wires {mean:.3f} mm, SD {sd:.3f} mm (the least 95 %, as PLUS has it)"]


_LONG_MM = 500.0
"""Half the length of wires whose ends are not known: more than any bath holds."""


def three_wires() -> WirePhantom:
    """Three wires that meet at right angles, along the axes of the phantom's frame: ``x``, ``y`` and ``z``.

    References
    ----------
    .. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, section 3.2.
    """
    ends_mm = _LONG_MM * np.stack([-np.eye(3), np.eye(3)], axis=1)
    return WirePhantom(("x", "y", "z"), ends_mm)
