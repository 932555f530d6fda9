"""Disagreements of images and sensors: both numbers, without a verdict."""

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import Doubt
from speckle3d.core.geometry import relative_poses, rigid
from speckle3d.core.sweep import OrientationSensor, Sweep, Tracker
from speckle3d.correction.claims import orientation_errors
from speckle3d.correction.settings import FusedSettings
from speckle3d.examine.sensors import SMOOTH, jitter

JOINT_CLAIMS = 3.0
"""Joint standard deviations beyond which two numbers disagree."""
UNITS = {1000.0: "metres", 100.0: "decimetres", 25.4: "inches", 10.0: "centimetres"}
UNIT_FACTOR = 1.5
"""Factor within which a path must be such a multiple: units are farther apart, paths by images nearer."""
BY_IMAGES = {"image", "consistent-subset", "orientation"}
"""Modes that take their length from the images alone."""
LEAST_SIGMA_MM = 0.1
"""Error of place that trackers have beside jitter: of a mounting off by 1 mm while the probe turns by 5
degrees. Without it one of 35 sound sweeps is told; twice as much changes none."""


def disagreements(
    sweep: Sweep, image: RigidTransform, covariance: FloatArray, errors: FusedSettings
) -> tuple[Doubt, ...]:
    """Compare images with each sensor in length, in-plane motion, roll and yaw; images tell no tilt well.

    Parameters
    ----------
    sweep : Sweep
        n frames.
    image : RigidTransform, length n
        Image-based poses, of the sign that was settled.
    covariance : ndarray, shape (n, 6, 6)
        Claimed for them.
    errors : FusedSettings
        Slow errors of orientation sensors.
    """
    doubts: list[Doubt] = []
    for sensor in (sweep.tracker, sweep.orientation):
        if sensor is None or sensor.sensor_from_image is None:
            continue
        frames = np.flatnonzero(sensor.covers(sweep.frame_time_s))
        if frames.size >= SMOOTH:
            doubts += _doubt_sensor(sensor, sweep, image[frames], covariance[frames], frames, errors)
    return tuple(doubts)


def _doubt_sensor(
    sensor: OrientationSensor | Tracker,
    sweep: Sweep,
    image: RigidTransform,
    covariance: FloatArray,
    frames: IntArray,
    errors: FusedSettings,
) -> Iterator[Doubt]:
    centre, about = sweep.grid.centre_mm, f"images and {sensor.label}"
    poses = rigid(sensor.world_from_image(sweep.frame_time_s[frames]))
    by_images, by_sensor = _motion(image, centre), _motion(poses, centre)
    travel = np.abs(by_images[:, 2])
    unit = unit_of_length(image, sensor, poses) if isinstance(sensor, Tracker) else ""
    # Poses between readings hide jitter, and a median over frames holds fewer readings than frames then.
    assert sensor.sensor_from_image is not None
    readings, frame_s = sensor.readings, sweep.frame_time_s
    noise = jitter(rigid(readings.world_from_sensor) * rigid(sensor.sensor_from_image), centre)
    per_reading = max(1.0, float(np.median(np.diff(readings.time_s)) / np.median(np.diff(frame_s))))
    slow = np.zeros_like(covariance)
    if isinstance(sensor, OrientationSensor):
        slow = orientation_errors(poses, centre, sweep.frame_time_s[frames], errors)
    for axis, name in (2, "length"), (0, "x"), (1, "y"), (5, "roll"), (4, "yaw"):
        if axis < 3 and not isinstance(sensor, Tracker):
            continue
        image_sigma = np.sqrt(covariance[:, axis, axis])
        least = LEAST_SIGMA_MM if axis < 3 else 0.0
        # Of the difference of two medians.
        jitter_left = noise[int(axis > 2)] * np.sqrt(np.pi * per_reading / SMOOTH)
        sensor_sigma = np.sqrt(jitter_left**2 + least**2 + slow[:, axis, axis])
        size = np.abs(by_images[:, axis] - by_sensor[:, axis]) / np.hypot(image_sigma, sensor_sigma)
        worst = int(np.argmax(travel if axis == 2 else size))
        if size[worst] > JOINT_CLAIMS or (unit and axis == 2):
            factor, mm = (1.0, "mm") if axis < 3 else (float(np.degrees(1.0)), "degrees")
            image_words, sensor_words = (
                f"{factor * float(path[worst, axis]):.3g} +- {1.96 * factor * float(sigma[worst]):.2g} {mm}"
                for path, sigma in ((by_images, image_sigma), (by_sensor, sensor_sigma))
            )
            words = f"{name} {image_words} by the images, {sensor_words} by the {sensor.label} (95 %)"
            yield Doubt(about, unit and f"units: {unit} for millimetres", words, False)
            return


def _motion(poses: RigidTransform, centre_mm: FloatArray) -> FloatArray:
    """(x, y, z, tilt, yaw, roll) summed over steps along each image's own axes, mm and rad, shape (n, 6).

    So no slow error of tilt or yaw, which images see badly, passes for one of place. Smoothed.
    """
    steps = relative_poses(poses)
    motion = np.hstack([steps.apply(centre_mm) - centre_mm, steps.rotation.as_rotvec()])
    path = np.concatenate([np.zeros((1, 6)), np.cumsum(motion, axis=0)])
    path = median_filter(path, (SMOOTH, 1), mode="mirror")
    return np.asarray(path - path[0])


def unit_of_length(image: RigidTransform, tracker: Tracker, poses: RigidTransform) -> str:
    """Name of the unit that a tracker's places are in, if its path is such a multiple of the images'; or "".

    Parameters
    ----------
    image, poses : RigidTransform, length n
        ``world_from_image`` by the images and by the tracker.
    """
    assert tracker.sensor_from_image is not None
    images, by_tracker = (
        np.linalg.norm(path.translation - path.translation[0], axis=1)
        for path in (image * tracker.sensor_from_image.inv(), poses * tracker.sensor_from_image.inv())
    )
    ratio = float((images * by_tracker).sum() / max((images**2).sum(), LEAST_SIGMA_MM**2))
    for factor, name in UNITS.items():
        for multiple, unit in (1.0 / factor, name), (factor, f"1/{factor:g} of a millimetre"):
            if 1.0 / UNIT_FACTOR < ratio / multiple < UNIT_FACTOR:
                return unit
    return ""


def differing_lengths(lengths: Mapping[str, tuple[float, float]]) -> tuple[Doubt, ...]:
    """Pairs of modes whose lengths differ by more than three joint claims.

    Those whose lengths are the images' own cannot contradict each other.

    Parameters
    ----------
    lengths : dict of str to (float, float)
        Length of each mode and its standard deviation, mm.
    """
    doubts = []
    for modes in combinations(lengths, 2):
        (a, a_sigma), (b, b_sigma) = (lengths[mode] for mode in modes)
        if not {*modes} <= BY_IMAGES and abs(a - b) > JOINT_CLAIMS * float(np.hypot(a_sigma, b_sigma)):
            words = (
                f"length {a:.2f} +- {1.96 * a_sigma:.2f} mm in mode {modes[0]}, {b:.2f} +- "
                f"{1.96 * b_sigma:.2f} mm in {modes[1]} (95 %)"
            )
            doubts.append(Doubt(f"modes {modes[0]} and {modes[1]}", "", words, False))
    return tuple(doubts)
