"""Scans of phantoms as geometry makes them: where a probe was, and what it would see. No solver's code."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.points import ImagePoints

BEAM_DOWN = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""An image that looks straight down in a world with z up: its x is the world's, its y points down."""

TRIAL_1 = RigidTransform.from_components(
    [-270.86, 4.86, -65.08],
    Rotation.from_euler("ZYX", np.deg2rad([-0.55, 44.22, -90.37])),
)
"""Cambridge phantom, Trial 1, of TR 303's Table 3: alpha, beta and gamma are about z, y and x."""
PIXEL_MM = np.array([0.137, 0.138])
COLUMNS = 290


@dataclass(frozen=True)
class PlaneScan:
    """Lines of a plane and the truth about them.

    Attributes
    ----------
    lines : ImagePoints
    world_from_image : RigidTransform
    """

    lines: ImagePoints
    world_from_image: RigidTransform


def about(axis, angles_rad):
    return Rotation.from_rotvec(np.outer(angles_rad, np.eye(3)[axis]))


def hand_turns(rng, count, tilt_deg=25.0, roll_deg=11.0, yaw_deg=90.0):
    """Orientations of the image about one that looks straight down, uniform in each angle."""
    tilt, roll, yaw = (
        np.deg2rad(rng.uniform(-r, r, count) if r else np.zeros(count)) for r in (tilt_deg, roll_deg, yaw_deg)
    )
    return about(2, yaw) * BEAM_DOWN * about(2, roll) * about(0, tilt)


def scan_plane(
    rng,
    count=697,
    *,
    tilt_deg=25.0,
    roll_deg=11.0,
    yaw_deg=90.0,
    depth_mm=(12.0, 34.0),
    beam_mm=0.0,
    line_noise_mm=0.0,
    sensor_from_image=TRIAL_1,
    floor=None,
):
    """The recipe that reproduces TR 303's Tables 3 and 6: uniform angles and depths."""
    turn = hand_turns(rng, count, tilt_deg, roll_deg, yaw_deg)
    up = turn.inv().apply([0.0, 0.0, 1.0])
    height = rng.uniform(*depth_mm, count) * np.abs(up[:, 1])
    place = np.column_stack([rng.uniform(-100, 100, (count, 2)), height])
    world_from_image = RigidTransform.from_components(place, turn)
    if floor is not None:
        world_from_image = floor * world_from_image
    ends = np.array([0.0, COLUMNS - 1.0])
    depth = -(height[:, None] + up[:, :1] * ends * PIXEL_MM[0]) / up[:, 1:2]
    depth -= beam_mm / 2 * np.abs(up[:, 2:] / up[:, 1:2])
    readings = world_from_image * sensor_from_image.inv()
    depth += line_noise_mm * rng.standard_normal((count, 2))
    points = np.stack([np.broadcast_to(ends, depth.shape), depth / PIXEL_MM[1]], axis=-1)
    return PlaneScan(ImagePoints.of_lines(np.arange(count), points, readings), world_from_image)


def line_directions(
    rng,
    count=100,
    *,
    noise_deg=0.1,
    sensor_noise_deg=0.1,
    heading_deg=0.0,
    from_below=False,
    mounting=None,
    **turns,
):
    """Directions of a plane's lines (square pixels), the sensor's readings, and the mounting."""
    if mounting is None:
        mounting = Rotation.random(rng=rng)
    turn = hand_turns(rng, count, **({"yaw_deg": 30.0} | turns))
    if from_below:
        turn = Rotation.from_euler("x", np.pi) * turn
    normal = turn.inv().apply([0.0, 0.0, 1.0])
    along = np.column_stack([-normal[:, 1], normal[:, 0]])
    along *= np.sign(along[:, :1]) / np.linalg.norm(along, axis=1, keepdims=True)
    angle = np.arctan2(along[:, 1], along[:, 0]) + np.deg2rad(noise_deg) * rng.standard_normal(count)
    jitter = Rotation.from_rotvec(np.deg2rad(sensor_noise_deg) * rng.standard_normal((count, 3)))
    heading = Rotation.from_rotvec([0.0, 0.0, np.deg2rad(heading_deg)])
    return np.column_stack([np.cos(angle), np.sin(angle)]), heading * turn * mounting.inv() * jitter, mounting


def scan_wires(
    rng,
    places_mm,
    *,
    sensor_from_image=TRIAL_1,
    world_from_phantom=None,
    noise_mm=0.0,
    **turns,
):
    """Pixels at which images show points of a phantom, one to a frame, and the sensor's readings.

    Parameters
    ----------
    places_mm : ndarray, shape (n, 3)
        In the phantom's frame.
    """
    count = len(places_mm)
    image_mm = rng.uniform([2.0, 5.0], [38.0, 38.0], (count, 2))
    turn = hand_turns(rng, count, **({"tilt_deg": 35.0, "roll_deg": 35.0} | turns))
    where = RigidTransform.identity() if world_from_phantom is None else world_from_phantom
    flat = np.column_stack([image_mm, np.zeros(count)])
    world_from_image = RigidTransform.from_components(where.apply(places_mm) - turn.apply(flat), turn)
    pixels = (image_mm + noise_mm * rng.standard_normal((count, 2))) / PIXEL_MM
    return pixels, world_from_image * sensor_from_image.inv()


def centre_of(sensor_from_image, pixel_mm):
    """The image's centre in the sensor's frame, mm; the image is as high as it is wide."""
    return sensor_from_image.apply(np.append(COLUMNS / 2 * pixel_mm, 0.0))
