"""A phantom known by formula: spheres, cut by images at known poses.

An image point's grey level follows from its distance to the nearest surface alone, as the share of its pixel
that lies inside: no voxels, no splatting, and no model of the estimator.
"""

from dataclasses import dataclass

import numpy as np
from drifting import hand_sweep

from speckle3d.core.grid import ImageGrid

OUTSIDE, INSIDE = 40.0, 200.0
LEVEL = (OUTSIDE + INSIDE) / 2


@dataclass(frozen=True)
class Ball:
    centre_mm: tuple[float, float, float]
    radius_mm: float

    @property
    def volume_mm3(self):
        return 4.0 / 3.0 * np.pi * self.radius_mm**3

    def depth(self, points):
        """How far inside points are; below zero outside."""
        return self.radius_mm - np.linalg.norm(points - np.asarray(self.centre_mm), axis=-1)


@dataclass(frozen=True)
class Phantom:
    balls: tuple
    grid: ImageGrid

    def image(self, pose):
        """Grey levels of the image at one pose, shape (vector, sample)."""
        x = self.grid.vector_pitch_mm * np.arange(self.grid.vectors)
        y = self.grid.first_sample_depth_mm + self.grid.sample_spacing_mm * np.arange(self.grid.samples)
        inside = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((x.size, y.size))], axis=-1)
        points = pose.apply(inside.reshape(-1, 3)).reshape(inside.shape)
        depth = np.max([ball.depth(points) for ball in self.balls], axis=0)
        share = np.clip(0.5 + depth / self.grid.sample_spacing_mm, 0.0, 1.0)
        return (OUTSIDE + (INSIDE - OUTSIDE) * share).astype(np.float32)

    def images(self, poses):
        return [self.image(pose) for pose in poses]


def by_hand(frames, length_mm, seed=0):
    """Poses of a hand's sweep from where its first image lies."""
    poses = hand_sweep(np.random.default_rng(seed), frames, length_mm)
    return poses[0].inv() * poses


def voxel_volume(volume, ball, step_mm):
    """Volume of a sphere by its voxels' grey levels, each counted by its share of the inside."""
    index = np.moveaxis(np.indices(volume.shape), 0, -1).reshape(-1, 3)
    near = ball.depth(volume.world_from_grid.apply(index * volume.spacing_mm)) > -3 * step_mm
    share = (volume.voxels.reshape(-1)[near] - OUTSIDE) / (INSIDE - OUTSIDE)
    return float(np.nansum(share) * np.prod(volume.spacing_mm))
