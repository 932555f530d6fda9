"""Sensed orientation for the consistent subset, and the sign of the elevational motion."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.sweep import Sweep, image_orientation


class SensorSettings(BaseModel):
    """How sensor streams are used."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    consistent_subset: bool = Field(
        True, description="In mode `orientation`, drop distances that the sensed orientation contradicts."
    )
    examine: bool = Field(
        True,
        description="Hold sensors against the images and themselves, and refuse those that are contradicted.",
    )
    smooth_s: float = Field(
        0.2,
        ge=0,
        description="Standard deviation of the Gaussian that smooths sensed orientation for the subset.",
    )
    direction: int = Field(
        0,
        ge=-1,
        le=1,
        description="Sign of the first elevational motion; 0: from a sensor, or positive without one.",
    )


def sensed_orientation(sweep: Sweep, settings: SensorSettings) -> Rotation | None:
    """Smoothed orientation of every frame; None if the subset is off or a frame has no reading."""
    sensor = sweep.orientation_source
    if not settings.consistent_subset or sensor is None or sensor.sensor_from_image is None:
        return None
    if not sensor.covers(sweep.frame_time_s).all():
        return None
    return smooth_rotations(
        image_orientation(sensor, sweep.frame_time_s), sweep.frame_time_s, settings.smooth_s
    )


def smooth_rotations(rotations: Rotation, time_s: FloatArray, sigma_s: float) -> Rotation:
    """Smooth rotations that stay within a half turn of their mean, by a Gaussian over time."""
    if sigma_s == 0 or len(rotations) < 3:
        return rotations
    mean = rotations.mean()
    vectors = (mean.inv() * rotations).as_rotvec()
    sigma = sigma_s / float(np.median(np.diff(time_s)))
    return mean * Rotation.from_rotvec(gaussian_filter1d(vectors, sigma, axis=0, mode="nearest"))


def settle_direction(
    sweep: Sweep, image: RigidTransform, settings: SensorSettings, turn_confirmed: bool = True
) -> tuple[int, str]:
    """Sign of the elevational motion, which images alone cannot tell, and its source.

    Parameters
    ----------
    turn_confirmed : bool
        Whether roll or a gyroscope confirm the orientation sensor's turns; it is not asked otherwise.
    """
    if settings.direction:
        return settings.direction, "setting"
    centre = sweep.grid.centre_mm
    if sweep.tracker is not None and sweep.tracker.sensor_from_image is not None:
        covered = np.flatnonzero(sweep.tracker.covers(sweep.frame_time_s))
        if covered.size > 1:
            measured = sweep.tracker.world_from_image(sweep.frame_time_s[covered])
            agreement = float(np.sum(_travel(measured, centre) * _travel(image[covered], centre)))
            return (1 if agreement >= 0 else -1), "tracker"
    calibrated = sweep.orientation is not None and sweep.orientation.sensor_from_image is not None
    if calibrated and turn_confirmed:
        turned = _turn_agreement(sweep, image)
        if turned is not None:
            return turned, "orientation sensor"
    if sweep.truth is not None:
        agreement = float(np.sum(_travel(sweep.truth, centre) * _travel(image, centre)))
        return (1 if agreement >= 0 else -1), "truth"
    return 1, "assumed"


def _travel(world_from_image: RigidTransform, centre_mm: FloatArray) -> FloatArray:
    """Elevational position of the image's centre in the first frame, less its mean."""
    z = (world_from_image[0].inv() * world_from_image).apply(centre_mm)[:, 2]
    return np.asarray(z - z.mean())


def _turn_agreement(sweep: Sweep, image: RigidTransform) -> int | None:
    """Whether image and sensor turn the same way, drift aside; None if they do not turn enough to tell."""
    sensor = sweep.orientation
    assert sensor is not None
    covered = np.flatnonzero(sensor.covers(sweep.frame_time_s))
    if covered.size < 20:
        return None
    measured = sensor.world_from_image(sweep.frame_time_s[covered])
    sensed = (measured[0].inv() * measured).as_rotvec()[:, :2]
    seen = (image.rotation[covered[0]].inv() * image.rotation[covered]).as_rotvec()[:, :2]
    t = np.linspace(-1, 1, covered.size)
    trend = np.vander(t, 3)
    left = [v - trend @ np.linalg.lstsq(trend, v, rcond=None)[0] for v in (sensed, seen)]
    power = float(np.sum(left[0] ** 2) * np.sum(left[1] ** 2))
    if power == 0:
        return None
    correlation = float(np.sum(left[0] * left[1])) / power**0.5
    # Slow turns have some ten independent values in a sweep: 0.5 is about two standard deviations.
    return None if abs(correlation) < 0.5 else int(np.sign(correlation))
