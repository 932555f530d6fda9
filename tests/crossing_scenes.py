"""Two crossing sweeps of soft tissue: cheap images whose speckle and reflections depend on the view.

Voxels of echogenicity, of speckle drawn anew for each sweep and blurred by its own thick beam, and of sheets
that reflect by the angle at which they are met; log-compressed, and sampled on the frames. None of it is in
the calibration's model.
"""

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.points import Recording
from speckle3d.core.geometry import rotation_from_fixed_angles
from speckle3d.core.grid import ImageGrid
from speckle3d.core.streams import TimedPoses

LENGTH_MM, FAN_DEG, VOXEL_MM = 24.0, 40.0, 0.5
MOUNTING = RigidTransform.from_components([12.0, -85.0, 23.0], rotation_from_fixed_angles(1.9, -0.8, 0.35))


def tissue(rng, size_mm):
    """Echogenicity in dB and a sheet's depth by lateral position, over a box (x, depth, z)."""
    shape = tuple((np.asarray(size_mm) / VOXEL_MM).astype(int))
    level = sum(
        sd
        * gaussian_filter(rng.standard_normal(shape, dtype=np.float32), mm / VOXEL_MM)
        * (mm / VOXEL_MM) ** 1.5
        for mm, sd in ((1.2, 16.0), (3.0, 16.0), (6.0, 12.0))
    )
    x, depth, z = np.meshgrid(
        *(np.arange(n, dtype=np.float32) * VOXEL_MM for n in shape), indexing="ij", sparse=True
    )
    for _ in range(14):
        centre, radius = rng.uniform(0.1, 0.9, 3) * size_mm, rng.uniform(1.5, 5.0, 3)
        ball = ((x - centre[0]) / radius[0]) ** 2 + ((depth - centre[1]) / radius[1]) ** 2
        level = np.where(
            ball + ((z - centre[2]) / radius[2]) ** 2 < 1.0, rng.choice([-14.0, -8.0, 7.0]), level
        )
    sheets = []
    for start in rng.uniform(0.15, 0.9, 4) * size_mm[1]:
        slope = rng.normal(0.0, 0.12, 2)
        sheets.append((depth - start - slope[0] * x - slope[1] * z + 0.6 * np.sin(0.3 * x + 0.2 * z), slope))
    return level.astype(np.float32), sheets


def grey_of(rng, level, sheets, elevation_axis):
    """Grey voxels as one sweep sees them: its own speckle, beam and reflections."""
    power = 10.0 ** (level / 10.0) * rng.standard_exponential(level.shape, dtype=np.float32)
    for away, slope in sheets:
        angle = np.hypot(*slope) + 0.15  # of the beam, rad
        power += 60.0 * np.exp(-((angle / 0.2) ** 2)) * np.exp(-0.5 * (away / 0.3) ** 2)
    blur = np.full(3, 0.45)
    blur[1], blur[elevation_axis] = 0.2, 1.1
    return 10.0 * np.log10(gaussian_filter(power, blur / VOXEL_MM, truncate=3.0) + 1e-3)


def crossing_sweeps(seed=0, frames=60, grid=None, fan_deg=FAN_DEG, crossing_deg=90.0):
    """Two sweeps of one scene, and the true sensor_from_image."""
    rng = np.random.default_rng(seed)
    grid = grid or ImageGrid(64, 240, 0.45, 0.14)
    side = max(LENGTH_MM, grid.width_mm) + 14.0 + grid.depth_mm * np.tan(np.deg2rad(fan_deg / 2.0))
    size = np.array([side, grid.depth_mm + 12.0, side])
    level, sheets = tissue(rng, size)
    sweeps = []
    for number in range(2):
        grey = grey_of(rng, level, sheets, 2 - 2 * number)
        poses = _path(rng, frames, fan_deg, crossing_deg * number, grid, size)
        images = _frames(grey, poses, grid)
        sensor = poses * MOUNTING.inv() * _jitter(rng, frames)
        time_s = np.arange(frames) * 0.04
        sweeps.append(Recording(images, grid, time_s, TimedPoses(time_s, sensor), name=f"sweep {number + 1}"))
    return sweeps[0], sweeps[1], MOUNTING


def displace(truth, rng, mm=20.0, deg=20.0):
    """A start, every parameter displaced at random."""
    turn = Rotation.from_euler("xyz", rng.uniform(-deg, deg, 3), degrees=True)
    return truth * RigidTransform.from_components(rng.uniform(-mm, mm, 3), turn)


def centre_error_mm(estimate, truth, grid):
    """How far the image's centre is off, along the image's own axes."""
    return (truth.inv() * estimate).apply(grid.centre_mm) - grid.centre_mm


def _path(rng, frames, fan_deg, turn_deg, grid, size_mm):
    """A slow sweep along z that tilts as it goes, turned about the depth axis, with a hand's wander."""
    s = np.linspace(-0.5, 0.5, frames) + 0.02 * np.sin(np.linspace(0, 9.0, frames) + rng.uniform(0, 6))
    wander = np.cumsum(rng.normal(0, 1, (frames, 6)), axis=0) / np.sqrt(frames)
    tilt = np.deg2rad(fan_deg) * s + 0.01 * wander[:, 3]
    rotation = rotation_from_fixed_angles(0.01 * wander[:, 5], 0.01 * wander[:, 4], tilt)
    place = np.column_stack([0.5 * wander[:, 0], 0.3 * wander[:, 1], LENGTH_MM * s])
    middle = RigidTransform.from_translation([-grid.width_mm / 2.0, 0.0, 0.0])
    about = RigidTransform.from_components(
        [size_mm[0] / 2.0, 3.0, size_mm[2] / 2.0], Rotation.from_euler("y", turn_deg, degrees=True)
    )
    return about * RigidTransform.from_components(place, rotation) * middle


def _frames(grey, poses, grid):
    flat = grid.mm(*np.indices((grid.vectors, grid.samples))).reshape(-1, 2)
    points = np.column_stack([flat, np.zeros(len(flat))])
    low, high = np.percentile(grey, [2.0, 99.9])
    images = np.empty((len(poses), grid.vectors, grid.samples), np.uint8)
    for n, pose in enumerate(poses):
        cut = map_coordinates(grey, pose.apply(points).T / VOXEL_MM, order=1, mode="nearest")
        images[n] = np.clip(255.0 * (cut - low) / (high - low), 0, 255).reshape(images.shape[1:])
    return images


def _jitter(rng, frames):
    """Of 0.1 mm and 0.05 degrees."""
    turn = Rotation.from_rotvec(np.deg2rad(0.05) * rng.standard_normal((frames, 3)))
    return RigidTransform.from_components(0.1 * rng.standard_normal((frames, 3)), turn)
