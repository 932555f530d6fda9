"""Images and sensors that say different things: both numbers, side by side. Either may be wrong."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.doubts import Doubt
from speckle3d.core.sweep import OrientationSensor, Sweep, Tracker
from speckle3d.examine.readings import jitter

JOINT_CLAIMS = 3.0
"""Joint standard deviations beyond which two numbers disagree (DESIGN, Disagreement)."""
UNITS = {1000.0: "metres", 100.0: "decimetres", 25.4: "inches", 10.0: "centimetres"}
UNIT_TOLERANCE = 0.2
"""Relative difference of a length from such a multiple: curves of another probe are wrong by less."""
FEWEST_FRAMES = 10
LEAST_SIGMA_MM, LEAST_SIGMA_RAD = 0.1, 0.013
"""Errors of place and roll that sensors have beside their jitter: of a mounting off by 1 mm or a third
of a degree while the probe turns by 5 degrees, and of a heading."""


def disagreements(
    sweep: Sweep, image: RigidTransform, covariance: FloatArray, length_sigma: float
) -> tuple[Doubt, ...]:
    """Compare what the images and each sensor say of length, of motion in the image's plane, and of roll.

    Parameters
    ----------
    sweep : Sweep
        n frames.
    image : RigidTransform, length n
        Image-based poses, of the sign that was settled.
    covariance : ndarray, shape (n, 6, 6)
        Claimed for them.
    length_sigma : float
        Relative standard deviation of their length.
    """
    found: list[Doubt] = []
    for sensor in (sweep.tracker, sweep.orientation):
        if sensor is None or sensor.sensor_from_image is None:
            continue
        covered = np.flatnonzero(sensor.covers(sweep.frame_time_s))
        if covered.size >= FEWEST_FRAMES:
            found += _compared(sensor, sweep, image[covered], covariance[covered], covered, length_sigma)
    return tuple(found)


def _compared(
    sensor: OrientationSensor | Tracker,
    sweep: Sweep,
    image: RigidTransform,
    covariance: FloatArray,
    covered: IntArray,
    length_sigma: float,
) -> Iterator[Doubt]:
    centre, about = sweep.grid.centre_mm, f"images and {sensor.label}"
    poses = sensor.world_from_image(sweep.frame_time_s[covered])
    if not isinstance(poses, RigidTransform):
        poses = RigidTransform.from_rotation(poses)
    by_images, by_sensor = (_motion(each, centre) for each in (image, poses))
    noise_mm, noise_deg = jitter(sensor)
    if isinstance(sensor, Tracker):
        farthest = int(np.argmax(np.abs(by_images[:, 2])))
        lengths = by_images[farthest, 2], by_sensor[farthest, 2]
        sigmas = abs(lengths[0]) * length_sigma, float(np.hypot(noise_mm, LEAST_SIGMA_MM))
        unit = unit_of_length(*lengths)
        if unit or apart(lengths, sigmas):
            words = _words("length", lengths, sigmas, "mm", sensor.label)
            yield Doubt(about, f"units: {unit} for millimetres" if unit else "", words, False)
            return
    axes = ((0, "x"), (1, "y"), (5, "roll")) if isinstance(sensor, Tracker) else ((5, "roll"),)
    for axis, name in axes:
        least = LEAST_SIGMA_MM if axis < 3 else LEAST_SIGMA_RAD
        noise = noise_mm if axis < 3 else np.deg2rad(noise_deg)
        sigma = np.sqrt(covariance[:, axis, axis]), float(np.hypot(noise, least))
        size = np.abs(by_images[:, axis] - by_sensor[:, axis]) / np.hypot(*sigma)
        worst = int(np.argmax(size))
        if size[worst] > JOINT_CLAIMS:
            factor, unit = (1.0, "mm") if axis < 3 else (float(np.degrees(1.0)), "degrees")
            numbers = factor * by_images[worst, axis], factor * by_sensor[worst, axis]
            errors = factor * float(sigma[0][worst]), factor * sigma[1]
            where = ((int(covered[worst]), int(covered[worst])),)
            words = _words(name, numbers, errors, unit, sensor.label)
            yield Doubt(about, "", words, False, where)


def _motion(poses: RigidTransform, centre_mm: FloatArray) -> FloatArray:
    """(x, y, z, tilt, yaw, roll) of the image's centre against the first frame, mm and rad, shape (n, 6)."""
    from_first = poses[0].inv() * poses
    return np.hstack([from_first.apply(centre_mm) - centre_mm, from_first.rotation.as_rotvec()])


def apart(numbers: tuple[float, float], sigmas: tuple[float, float]) -> bool:
    """Whether two numbers differ by more than their joint claims allow."""
    return abs(numbers[0] - numbers[1]) > JOINT_CLAIMS * float(np.hypot(*sigmas))


def unit_of_length(by_images_mm: float, by_sensor: float) -> str:
    """Name of the unit that a sensor's length is in, if it is such a multiple of the images'; else empty."""
    for factor, name in UNITS.items():
        for ratio, unit in ((factor, name), (1.0 / factor, f"1/{factor:g} of a millimetre")):
            if abs(by_sensor * ratio / by_images_mm - 1.0) < UNIT_TOLERANCE:
                return unit
    return ""


def differing_lengths(lengths: Mapping[str, tuple[float, float]]) -> tuple[Doubt, ...]:
    """Modes whose lengths differ by more than three joint claims: among these there is no best.

    Parameters
    ----------
    lengths : dict of str to (float, float)
        Length of each mode and its standard deviation, mm.
    """
    found = []
    for (one, (first, own)), (other, (second, its)) in combinations(lengths.items(), 2):
        if apart((first, second), (own, its)):
            words = (
                f"length {first:.2f} +- {own:.2f} mm in mode {one}, {second:.2f} +- {its:.2f} mm in {other}"
            )
            found.append(Doubt(f"modes {one} and {other}", "", words, False))
    return tuple(found)


def _words(
    name: str, numbers: tuple[float, float], sigmas: tuple[float, float], unit: str, sensor: str
) -> str:
    images, other = (f"{n:.3g} +- {s:.2g} {unit}" for n, s in zip(numbers, sigmas, strict=True))
    return f"{name} {images} by the images, {other} by the {sensor}"
