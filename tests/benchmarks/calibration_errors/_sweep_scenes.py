"""Pairs of tracked sweeps over random tissue, by a model that the calibration from images does not have.

One field of scatterers is seen by each sweep through its own oriented beam and carrier, so speckle is shared
by parallel views only. The beam is thin at its focus and thick elsewhere, bright tissue casts shadows along
the scan lines, interfaces reflect by the angle at which they are met, each sweep has its own gain by depth
and compression. The tracker errs by white noise and by an error that wanders in time, anew in each sweep.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import fftn, ifftn
from scipy.ndimage import gaussian_filter, gaussian_filter1d, map_coordinates
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.images.stacks import TrackedImages
from speckle3d.core.streams import TimedPoses
from speckle3d.core.sweep import ImageGrid

KINDS = ("blobs", "tubes", "mixture", "layers")
_VOXEL_MM = 0.5
_CARRIER_PER_MM = 2.0 * 2.0 * np.pi / 0.4
"""Phase of an echo per mm of depth; twice a wave's, for the way there and back."""


@dataclass(frozen=True)
class SceneSettings:
    """What a pair of sweeps is like.

    Parameters
    ----------
    seed : int
    kind : str
        Tissue, one of `KINDS`.
    crossing_deg, fan_deg : float
        Between the sweeps' directions, and the probe's tilt within each.
    contrast : float
        Factor on the tissue's differences in dB.
    drift : float
        Size of the tracker's wandering error: 1 is 0.3 mm and 0.2 degrees over 5 s.
    """

    seed: int
    kind: str = "mixture"
    crossing_deg: float = 90.0
    fan_deg: float = 40.0
    contrast: float = 1.0
    drift: float = 0.0


@dataclass(frozen=True)
class Scene:
    """A pair of sweeps with the truth and a start that is off by up to 20 mm and 20 degrees a parameter."""

    first: TrackedImages
    second: TrackedImages
    truth: RigidTransform
    far_start: RigidTransform
    near_start: RigidTransform


def scene(settings: SceneSettings) -> Scene:
    """Draw tissue, probe, mounting, motion and errors from the seed."""
    rng = np.random.default_rng([settings.seed, KINDS.index(settings.kind)])
    depth = rng.uniform(32.0, 48.0)
    vectors, samples = int(rng.integers(56, 80)), int(rng.integers(150, 220))
    grid = ImageGrid(vectors, samples, rng.uniform(28.0, 38.0) / vectors, depth / samples)
    length, frames = rng.uniform(10.0, 24.0), int(rng.integers(40, 60))
    side = max(length, grid.width_mm) + 12.0 + depth * np.tan(np.deg2rad(settings.fan_deg / 2.0))
    size = np.array([side, depth + 10.0, side])
    level, interfaces = _tissue(rng, settings.kind, size)
    level *= np.float32(settings.contrast)
    scatterers = rng.standard_normal((2, *level.shape), dtype=np.float32)
    mounting = RigidTransform.from_components(rng.uniform(-90.0, 90.0, 3), Rotation.random(rng=rng))
    made = []
    for number in range(2):
        poses = _path(rng, frames, length, settings, settings.crossing_deg * number, grid, size)
        images = _images(rng, level, interfaces, scatterers, poses, grid)
        time_s = np.arange(frames) / rng.choice([8.3, 12.5, 20.0])
        errors = _tracker_errors(rng, time_s, settings.drift)
        about = RigidTransform.from_translation(size / 2.0)
        world = about * errors * about.inv() * poses * mounting.inv()
        room = RigidTransform.from_components(
            [120.0, -300.0, 40.0], Rotation.from_euler("xyz", [0.3, 1.1, -2.0])
        )
        made.append(
            TrackedImages(images, grid, time_s, TimedPoses(time_s, room * world), name=f"sweep {number + 1}")
        )
    far, near = (_displaced(rng, mounting, grid, amount) for amount in (20.0, 1.5))
    return Scene(made[0], made[1], mounting, far, near)


def _displaced(rng, mounting, grid, amount):
    turn = Rotation.from_euler("xyz", rng.uniform(-amount, amount, 3), degrees=True)
    return mounting * RigidTransform.from_components(rng.uniform(-amount, amount, 3), turn)


def _tissue(rng, kind, size_mm):
    """Echogenicity in dB over a box (x, depth, z), and where interfaces reflect when met squarely."""
    shape = tuple((size_mm / _VOXEL_MM).astype(int))
    x, y, z = np.meshgrid(
        *(np.arange(n, dtype=np.float32) * _VOXEL_MM for n in shape), indexing="ij", sparse=True
    )
    level = np.zeros(shape, np.float32)
    # Fine variation of all tissue.
    fine = gaussian_filter(rng.standard_normal(shape, dtype=np.float32), rng.uniform(2.0, 4.0))
    level += (1.0 if kind == "layers" else rng.uniform(2.0, 4.0)) * fine / fine.std()
    interfaces = np.zeros(shape, np.float32)
    if kind in ("blobs", "mixture"):
        for _ in range(rng.integers(40, 80)):
            centre, radius = rng.uniform(0.05, 0.95, 3) * size_mm, rng.uniform(1.5, 6.0, 3)
            away = np.sqrt(
                ((x - centre[0]) / radius[0]) ** 2
                + ((y - centre[1]) / radius[1]) ** 2
                + ((z - centre[2]) / radius[2]) ** 2
            )
            level += rng.choice([-20.0, -12.0, 8.0, 14.0]) / (1.0 + np.exp(6.0 * (away - 1.0)))
    if kind in ("tubes", "mixture"):
        for _ in range(rng.integers(8, 14)):
            way = rng.standard_normal(3) * [1.0, 0.5, 1.0]
            way /= np.linalg.norm(way)
            p, radius = rng.uniform(0.1, 0.9, 3) * size_mm, rng.uniform(1.0, 3.5)
            bend = rng.uniform(0.0, 3.0) * np.sin((x * way[0] + z * way[2]) / rng.uniform(6.0, 15.0))
            along = (x - p[0]) * way[0] + (y - p[1]) * way[1] + (z - p[2]) * way[2]
            away = np.sqrt(
                (x - p[0] - along * way[0]) ** 2
                + (y - p[1] - along * way[1] + bend) ** 2
                + (z - p[2] - along * way[2]) ** 2
            )
            level -= 22.0 / (1.0 + np.exp(3.0 * (away - radius)))
            interfaces += np.exp(-0.5 * ((away - radius) / 0.4) ** 2)
    if kind in ("layers", "mixture"):
        curve = 0.01 if kind == "layers" else 0.06
        bumps = gaussian_filter(rng.standard_normal((shape[0], shape[2])), 8.0 / _VOXEL_MM)[:, None, :]
        bent = (
            y
            + curve * (rng.normal() * x + rng.normal() * z)
            + (0.15 if kind == "layers" else 1.0) * bumps / bumps.std()
        )
        for edge in np.sort(rng.uniform(0.1, 0.95, 6 if kind == "layers" else 3)) * size_mm[1]:
            level += rng.uniform(-12.0, 12.0) / (1.0 + np.exp(-4.0 * (bent - edge)))
            interfaces += rng.uniform(0.3, 1.0) * np.exp(-0.5 * ((bent - edge) / 0.4) ** 2)
    return level, interfaces


def _path(rng, frames, length_mm, settings, heading_deg, grid, size_mm):
    """A smooth hand: slides and tilts at its own pace, and wanders in all six ways."""
    pace = np.cumsum(np.exp(0.5 * _smooth(rng, frames, 0.2)))
    s = (pace - pace[0]) / np.ptp(pace) - 0.5
    if rng.random() < 0.3:
        tilt = 0.5 * np.sin(2.0 * np.pi * rng.uniform(0.8, 1.5) * s + rng.uniform(-0.5, 0.5))
    else:
        tilt = s * rng.choice([-1.0, 1.0])
    wander = np.column_stack([_smooth(rng, frames, 0.3) for _ in range(6)])
    wander *= rng.uniform(0.2, 1.0)
    tilts = np.deg2rad(settings.fan_deg) * tilt + 0.015 * wander[:, 0]
    turn = Rotation.from_euler("yzx", np.column_stack([0.02 * wander[:, 1], 0.02 * wander[:, 2], tilts]))
    place = np.column_stack([0.8 * wander[:, 3], 0.3 * wander[:, 4], length_mm * s + 0.3 * wander[:, 5]])
    middle = RigidTransform.from_translation([-grid.width_mm / 2.0, 0.0, 0.0])
    lean = Rotation.from_euler(
        "xyz", [*rng.normal(0.0, 4.0, 2) * [1.0, 0.0], rng.normal(0.0, 4.0)], degrees=True
    )
    about = RigidTransform.from_components(
        [size_mm[0] / 2.0, 2.5, size_mm[2] / 2.0], Rotation.from_euler("y", heading_deg, degrees=True) * lean
    )
    return about * RigidTransform.from_components(place, turn) * middle


def _smooth(rng, frames, share):
    """A smooth random course of unit standard deviation, correlated over a share of its length."""
    course = gaussian_filter1d(rng.standard_normal(3 * frames), share * frames)[frames : 2 * frames]
    return (course - course.mean()) / max(course.std(), 1e-9)


def _images(rng, level, interfaces, scatterers, poses, grid):
    """8-bit B-mode of one sweep."""
    axes = poses[len(poses) // 2].rotation.as_matrix()
    speckle = _speckle(scatterers, axes)
    u, v = np.meshgrid(np.arange(grid.vectors), np.arange(grid.samples), indexing="ij")
    points = np.stack([u * grid.vector_pitch_mm, v * grid.sample_spacing_mm, 0.0 * u], axis=-1)
    focus = rng.uniform(0.4, 0.7) * grid.depth_mm
    thick = np.hypot(0.5, 0.05 * (points[..., 1] - focus))
    gain = rng.uniform(-4.0, 4.0) + rng.uniform(-4.0, 4.0) * (v / grid.samples) ** 2
    edge = -rng.uniform(0.0, 3.0) * np.abs(2.0 * u / grid.vectors - 1.0) ** 3
    shade, mirror = rng.uniform(0.0, 0.015), rng.uniform(6.0, 14.0)
    frames = np.empty((len(poses), grid.vectors, grid.samples))
    slope = np.stack(np.gradient(gaussian_filter(interfaces, 1.0)), axis=0).astype(np.float32)
    steep = np.sqrt((slope**2).sum(axis=0)) + 1e-6
    for n, pose in enumerate(poses):
        power = np.zeros(u.shape)
        beam = pose.rotation.apply([0.0, 1.0, 0.0])
        for offset, share in ((-1.2, 0.23), (0.0, 0.54), (1.2, 0.23)):
            beside = points + np.stack([0.0 * u, 0.0 * u, offset * thick], axis=-1)
            place = pose.apply(beside.reshape(-1, 3)).T / _VOXEL_MM
            there = map_coordinates(level, place, order=1, mode="nearest").reshape(u.shape)
            power += share * 10.0 ** (there / 10.0)
        centre = pose.apply(points.reshape(-1, 3)).T / _VOXEL_MM
        at = [map_coordinates(part, centre, order=1, mode="nearest") for part in (*slope, steep, interfaces)]
        square = np.clip((np.abs(np.stack(at[:3], axis=-1) @ beam) / at[3]), 0.0, 1.0) ** 12
        power *= 1.0 + mirror * (square * at[4]).reshape(u.shape)
        noise = [map_coordinates(part, centre, order=1, mode="nearest") for part in speckle]
        seen = power * (noise[0] ** 2 + noise[1] ** 2).reshape(u.shape)
        shadow = np.cumsum(np.clip(10.0 * np.log10(power) - 5.0, 0.0, 8.0), axis=1) * grid.sample_spacing_mm
        frames[n] = 10.0 * np.log10(seen + 1e-3) - shade * 4.0 * shadow + gain + edge
    frames = gaussian_filter(frames, [0.0, 0.25 / grid.vector_pitch_mm, 0.1 / grid.sample_spacing_mm])
    top, span = np.percentile(frames, rng.uniform(98.5, 99.9)), rng.uniform(40.0, 55.0)
    return np.clip(255.0 * (1.0 + (frames - top) / span), 0, 255).astype(np.uint8)


def _speckle(scatterers, axes):
    """Echoes of the scatterers through a beam oriented by the image's axes (columns), two parts."""
    shape = scatterers.shape[1:]
    x, y, z = np.meshgrid(*(np.arange(n) * _VOXEL_MM for n in shape), indexing="ij", sparse=True)
    beam = axes[:, 1]
    carrier = np.exp(1j * _CARRIER_PER_MM * (beam[0] * x + beam[1] * y + beam[2] * z)).astype(np.complex64)
    k = np.meshgrid(*(2.0 * np.pi * np.fft.fftfreq(n, _VOXEL_MM) for n in shape), indexing="ij", sparse=True)
    exponent = 0.0
    for axis, sigma in zip(axes.T, (0.5, 0.2, 0.9), strict=True):
        exponent = exponent + (sigma * (axis[0] * k[0] + axis[1] * k[1] + axis[2] * k[2])) ** 2
    seen = ifftn(
        fftn((scatterers[0] + 1j * scatterers[1]) * carrier) * np.exp(-0.5 * exponent).astype(np.float32)
    )
    seen /= np.sqrt((np.abs(seen) ** 2).mean())
    return seen.real.astype(np.float32), seen.imag.astype(np.float32)


def _tracker_errors(rng, time_s, drift):
    """White noise of 0.08 mm and 0.04 degrees, and a wandering error about the middle of the tissue."""
    mm, deg = 0.08 * rng.standard_normal((len(time_s), 3)), 0.04 * rng.standard_normal((len(time_s), 3))
    keep = np.exp(-np.diff(time_s) / 5.0)
    course = rng.standard_normal((len(time_s), 6))
    for n, part in enumerate(keep):
        course[n + 1] = part * course[n] + np.sqrt(1.0 - part**2) * course[n + 1]
    mm += 0.3 * drift * course[:, :3]
    deg += 0.2 * drift * course[:, 3:]
    return RigidTransform.from_components(mm, Rotation.from_rotvec(np.deg2rad(deg)))
