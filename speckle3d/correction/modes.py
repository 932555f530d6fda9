"""Drift modes by name: what each needs of a sweep, and the sweep's poses corrected."""

from __future__ import annotations

from collections.abc import Sequence

from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InsufficientDataError, InvalidInputError, naming
from speckle3d.core.sweep import OrientationSensor, Sweep, Tracker, image_orientation
from speckle3d.correction.drift import DriftCorrection, DriftSettings, correct_orientation, correct_pose

PUBLISHED = ("orientation", "pose")
"""The modes of Housden et al. 2008, which fit cubics."""
DRIFT_MODES = (*PUBLISHED, "crossed", "inertial", "fused")


def require_modes(sweep: Sweep, modes: Sequence[str], crossing: bool = False) -> None:
    """Check that the sweep has what every drift mode needs, before any work is done.

    Parameters
    ----------
    crossing : bool
        Whether there is a crossing sweep.

    Raises
    ------
    InvalidInputError
        If a mode is unknown.
    InsufficientDataError
        If what it needs is missing, not calibrated to the image, or covers no frame.
    """
    for mode in modes:
        if mode not in DRIFT_MODES:
            raise InvalidInputError(f"expected a drift mode among {', '.join(DRIFT_MODES)}; got {mode!r}")
        where = f"{sweep.name}: drift mode {mode}"
        if mode == "crossed":
            if not crossing:
                raise InsufficientDataError(
                    f"{where}: expected a crossing sweep (--crossing SWEEP), got none"
                )
            continue
        sensor = sensor_of(sweep, mode)
        if sensor is None:
            if mode == "fused" and crossing:
                continue
            raise InsufficientDataError(f"{where}: expected {_WANTED[mode]}, got none")
        if sensor.sensor_from_image is None:
            raise InsufficientDataError(f"{where}: {sensor.uncalibrated}")
        if not sensor.covers(sweep.frame_time_s).any():
            raise InsufficientDataError(f"{where}: expected readings over the frames, got none")
        if mode == "inertial":
            _require_inertial(sensor, where)


_WANTED = {
    "pose": "a tracker in /tracker",
    "orientation": "an orientation sensor in /orientation",
    "inertial": "an orientation sensor with accelerometer and gyroscope in /orientation",
    "fused": "a sensor in /orientation or /tracker, or a crossing sweep",
}


def sensor_of(sweep: Sweep, mode: str) -> OrientationSensor | Tracker | None:
    """The sensor that a drift mode needs; None for those that need none."""
    if mode == "crossed":
        return None
    if mode == "inertial":
        return sweep.orientation
    return sweep.tracker if mode == "pose" else sweep.orientation_source


def _require_inertial(sensor: OrientationSensor | Tracker, where: str) -> None:
    for name in ("accelerometer_m_s2", "gyroscope_rad_s"):
        if getattr(sensor, name, None) is None:
            raise InsufficientDataError(f"{where}: expected {name} in /orientation, got none")


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
