"""Drift modes by name: what each needs of a sweep, and the sweep's poses corrected."""

from collections.abc import Sequence
from dataclasses import replace

from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, naming
from speckle3d.core.sweep import OrientationSensor, Sweep, Tracker, image_orientation
from speckle3d.correction.claims import length_sigma, orientation_errors, tracker_errors
from speckle3d.correction.drift import DriftCorrection, DriftSettings, correct_orientation, correct_pose
from speckle3d.correction.settings import FusedSettings

CUBIC_MODES = ("orientation", "pose")
"""The modes of Housden et al. 2008, which fit cubics."""
DRIFT_MODES = (*CUBIC_MODES, "crossed", "fused")

_REMOVED_MODES = {"inertial": "`fused` takes any sensor there is, `crossed` a second sweep across the first"}
"""Modes that only older files hold, and what is there instead."""


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
        if mode in _REMOVED_MODES:
            raise InvalidInputError(f"drift mode {mode} was removed: {_REMOVED_MODES[mode]}")
        if mode not in DRIFT_MODES:
            raise InvalidInputError(f"expected a drift mode among {', '.join(DRIFT_MODES)}; got {mode!r}")
        where = f"{sweep.name}: drift mode {mode}"
        if mode == "crossed":
            if not crossing:
                raise InsufficientDataError(
                    f"{where}: expected a crossing sweep (--crossing SWEEP), got none"
                )
            continue
        if mode == "fused" and crossing:
            continue
        sensor = sensor_of(sweep, mode)
        if sensor is None:
            raise InsufficientDataError(f"{where}: expected {_NEEDS[mode]}, got none")
        if sensor.sensor_from_image is None:
            raise InsufficientDataError(f"{where}: {sensor.uncalibrated}")
        if not sensor.covers(sweep.frame_time_s).any():
            raise InsufficientDataError(f"{where}: expected readings over the frames, got none")


_NEEDS = {
    "pose": "a tracker in /tracker",
    "orientation": "an orientation sensor in /orientation",
    "fused": "a sensor in /orientation or /tracker, or a crossing sweep",
}


def sensor_of(sweep: Sweep, mode: str) -> OrientationSensor | Tracker | None:
    """The sensor that a drift mode needs, of several a calibrated one; None for those that need none."""
    if mode == "crossed":
        return None
    if mode == "fused" and sweep.orientation is not None and sweep.orientation.sensor_from_image is None:
        return sweep.tracker or sweep.orientation
    return sweep.tracker if mode == "pose" else sweep.orientation or sweep.tracker


def correct_mode(
    mode: str,
    world_from_image: RigidTransform,
    sweep: Sweep,
    settings: DriftSettings,
    image_covariance: FloatArray,
    errors: FusedSettings,
    wander_mm: float,
) -> DriftCorrection:
    """Correct image-based poses by the sensor that a mode stands for; see `require_modes`.

    Parameters
    ----------
    mode : str
        ``"pose"`` or ``"orientation"``.
    world_from_image : RigidTransform, length n
        Of every frame of `sweep`.
    image_covariance : ndarray, shape (n, 6, 6)
        Claimed for the image-based poses but for their turns; `orientation` leaves errors of place as they
        are.
    errors : FusedSettings
        Errors of the sensors that their readings do not show.
    wander_mm : float
        Of a tracker's places, as mode `fused` finds it.
    """
    sensor = sensor_of(sweep, mode)
    assert sensor is not None
    time_s, centre_mm = sweep.frame_time_s, sweep.grid.centre_mm
    has_reading = sensor.covers(time_s)
    with naming(sweep.name):
        if isinstance(sensor, Tracker) and mode == "pose":
            reference = sensor.world_from_image(time_s[has_reading])
            correction = correct_pose(
                world_from_image, reference, has_reading, sweep.grid.corners_mm, settings
            )
            covariance = correction.covariance + tracker_errors(
                correction.poses, centre_mm, time_s, errors, wander_mm
            )
        else:
            rotation = image_orientation(sensor, time_s[has_reading])
            correction = correct_orientation(world_from_image, rotation, has_reading, centre_mm, settings)
            covariance = correction.covariance.copy()
            covariance[:, :3, :3] += image_covariance[:, :3, :3]
            if isinstance(sensor, OrientationSensor):
                covariance += orientation_errors(correction.poses, centre_mm, time_s, errors)
    sigma = length_sigma(correction.poses, covariance, centre_mm)
    return replace(correction, covariance=covariance, length_sigma=sigma)
