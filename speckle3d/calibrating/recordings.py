"""Recordings of a calibration phantom: images, and sensor readings from the same or another file."""

import warnings
from pathlib import Path

from calibration.points import Recording
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import BModeSettings, OrientationSensor, Sweep
from speckle3d.examine.sensors import doubts_of_gravity
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.load import IMAGE, SIZED, kind_of, load_sweep
from speckle3d.io.load import open_recording as open_sweep
from speckle3d.io.pose_paths import without_jumps
from speckle3d.io.toml import validated
from speckle3d.study.images import GreyImages

DYNAMIC_RANGE_DB = 60.0
"""Dynamic range of images made from RF, and assumed of imported images, whose grey levels alone are used."""


def open_recording(
    images: Path,
    poses: Path | None,
    pixel_mm: tuple[float, float] | None,
    sensor: str = "tracker",
    transform: str | None = None,
    outside: float = 0.0,
) -> Recording:
    """Open images and the readings of one sensor.

    Parameters
    ----------
    poses : Path, optional
        Where the readings are, if not beside the images.
    sensor : {"tracker", "orientation"}
    transform : str, optional
        Name of the poses in an image sequence, as ``ToolToTracker``.
    outside : float
        Grey level outside a fan.

    Raises
    ------
    InsufficientDataError
        If there is no such sensor.
    """
    sweep = _load(images, pixel_mm, transform if poses is None else None)
    readings, offset_s = (
        _readings(sweep, images, sensor) if poses is None else _readings_of(poses, sensor, transform)
    )
    pictures, grid = sweep.frames, sweep.grid
    is_grey = isinstance(sweep.signal, BModeSettings)
    if not is_grey or grid.fan is not None:
        grey = GreyImages(
            sweep, DYNAMIC_RANGE_DB, clipped=False, levels="stored" if is_grey else "log", outside=outside
        )
        pictures, grid = grey, grey.grid
    mounting = sweep.tracker.sensor_from_image if sweep.tracker else None
    return Recording(pictures, grid, sweep.frame_time_s, readings, offset_s, images.name, mounting)


def _load(path: Path, pixel_mm: tuple[float, float] | None, transform: str | None) -> Sweep:
    column, row = pixel_mm or (None, None)
    options = validated(
        {"column_pitch_mm": column, "row_spacing_mm": row, "tracker_transform": transform},
        "--pixel-mm",
        ImportSettings,
    )
    require_unsaid(path, options)
    try:
        return load_sweep(path, options.model_copy(update={"dynamic_range_db": DYNAMIC_RANGE_DB}))
    except MissingSettingsError as error:
        raise InvalidInputError(
            f"{path}: the recording does not say its {', '.join(error.settings)}: give --pixel-mm COLUMN "
            f"ROW, roughly, for the size of a pixel, and what else there is in {path.name}.toml"
        ) from None


def require_unsaid(path: Path, options: ImportSettings) -> None:
    """Refuse settings for a recording that says all of them itself.

    Raises
    ------
    InvalidInputError
    """
    names = sorted(name for name in options.model_fields_set if getattr(options, name) is not None)
    if names and kind_of(path) in SIZED:
        words = ", ".join(names).replace("_", " ")
        raise InvalidInputError(f"{path} ({kind_of(path)}) has its own {words}: expected no option for that")


def _readings(sweep: Sweep, path: Path, sensor: str) -> tuple[TimedPoses | TimedRotations, float]:
    stream = getattr(sweep, sensor)
    if stream is None:
        content = "none (of a file of PLUS, --transform names others)"
        if sweep.tracker is not None:
            content = "a tracker (--sensor tracker uses its orientation)"
        raise InsufficientDataError(
            f"{path}: expected readings of the {sensor} there or in --poses, got {content}"
        )
    if isinstance(stream, OrientationSensor):
        for doubt in doubts_of_gravity(stream):
            warnings.warn(f"{path}: {doubt}", stacklevel=2)
    return stream.readings, stream.time_offset_s


def _readings_of(path: Path, sensor: str, transform: str | None) -> tuple[TimedPoses | TimedRotations, float]:
    if kind_of(path) != IMAGE:
        return _readings(load_sweep(path), path, sensor)
    recording = open_sweep(path, ImportSettings(tracker_transform=transform))
    if not (tracker := recording.tracker):
        if recording.fault is not None and not recording.remarks:
            raise recording.fault
        reasons = "; ".join(recording.remarks) or "none"
        raise InvalidInputError(f"{path}: expected poses, as ProbeToTrackerTransform, got {reasons}")
    poses, notes = without_jumps(tracker.readings)
    for remark in (*recording.remarks, *notes):
        warnings.warn(f"{path}: {remark}", stacklevel=2)
    turns = TimedRotations(poses.time_s, poses.world_from_sensor.rotation)
    return turns if sensor == "orientation" else poses, tracker.time_offset_s
