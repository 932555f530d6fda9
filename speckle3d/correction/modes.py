"""Drift modes by name: what each needs of a sweep, and the sweep's poses corrected."""

from __future__ import annotations

from collections.abc import Sequence

from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InsufficientDataError, InvalidInputError, naming
from speckle3d.core.sweep import OrientationSensor, Sweep, Tracker, image_orientation
from speckle3d.correction.drift import DriftCorrection, DriftSettings, correct_orientation, correct_pose


def require_modes(sweep: Sweep, modes: Sequence[str]) -> None:
    """Check that the sweep has what every drift mode needs, before any work is done.

    Raises
    ------
    InvalidInputError
        If a mode is unknown.
    InsufficientDataError
        If its sensor is missing, not calibrated to the image, or covers no frame.
    """
    sensors: dict[str, tuple[OrientationSensor | Tracker | None, str]] = {
        "pose": (sweep.tracker, "a tracker in /tracker"),
        "orientation": (sweep.orientation_source, "an orientation sensor in /orientation"),
    }
    for mode in modes:
        if mode not in sensors:
            raise InvalidInputError(f"expected a drift mode among orientation, pose; got {mode!r}")
        sensor, wanted = sensors[mode]
        where = f"{sweep.name}: drift mode {mode}"
        if sensor is None:
            raise InsufficientDataError(f"{where}: expected {wanted}, got none")
        if sensor.sensor_from_image is None:
            raise InsufficientDataError(f"{where}: {sensor.uncalibrated}")
        if not sensor.covers(sweep.frame_time_s).any():
            raise InsufficientDataError(f"{where}: expected readings over the frames, got none")


def sensor_of(sweep: Sweep, mode: str) -> OrientationSensor | Tracker | None:
    """The sensor that a drift mode uses."""
    return sweep.tracker if mode == "pose" else sweep.orientation_source


def correct_mode(
    mode: str, world_from_image: RigidTransform, sweep: Sweep, settings: DriftSettings
) -> DriftCorrection:
    """Correct image-based poses by the sensor that a mode stands for; see `require_modes`.

    Parameters
    ----------
    mode : str
        ``"pose"`` or ``"orientation"``.
    world_from_image : RigidTransform, length n
        Of every frame of `sweep`.
    """
    sensor = sensor_of(sweep, mode)
    assert sensor is not None
    covered = sensor.covers(sweep.frame_time_s)
    times = sweep.frame_time_s[covered]
    with naming(sweep.name):
        if isinstance(sensor, Tracker) and mode == "pose":
            poses = sensor.world_from_image(times)
            return correct_pose(world_from_image, poses, covered, sweep.grid.corners_mm, settings)
        rotation = image_orientation(sensor, times)
        return correct_orientation(world_from_image, rotation, covered, sweep.grid.centre_mm, settings)
