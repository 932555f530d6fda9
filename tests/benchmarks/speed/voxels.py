"""Voxels of 0.25 mm of a wavering sweep of 300 frames of 640 x 480 pixels of 0.1 mm, 8 bits.

Beside them stands IGSIO, the reconstruction inside PLUS and 3D Slicer, built and timed elsewhere, on a
machine of two cores like the one that the README's figures are from; it is not run here.
"""

from contextlib import nullcontext

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.grid import ImageGrid
from speckle3d.core.threads import on_one_thread
from speckle3d.core.volume import MEASURED
from speckle3d.imaging.voxels.grid import VoxelGrid
from speckle3d.imaging.voxels.holes import fill_holes
from speckle3d.imaging.voxels.volume import compound
from speed.rows import Row, time_runs

GRID = ImageGrid(640, 480, 0.1, 0.1)
VOXELS = VoxelGrid((273, 193, 240), (0.25, 0.25, 0.25), RigidTransform.identity())
FRAMES, LENGTH_MM = 300, 56.0
TARGETS = {"nearest": 400, "linear": 120}
IGSIO = {("nearest", 1): 172, ("nearest", 2): 207, ("linear", 1): 15, ("linear", 2): 28}
"""Million pixels per second, with the mean, by threads: IGSIO of 2024."""


def wavering():
    """Poses along the voxels' k axis."""
    rng = np.random.default_rng(0)
    rotation = Rotation.from_rotvec(0.03 * np.sin(np.linspace(0, 9, FRAMES))[:, None] * rng.normal(size=3))
    along = np.linspace(1.5, 1.5 + LENGTH_MM, FRAMES) + rng.normal(0, 0.02, FRAMES)
    return RigidTransform.from_components(np.insert([[2.0, 0.2]] * FRAMES, 2, along, axis=1), rotation)


def rows(runs):
    """Both splats on one and two threads, and holes of a fifth of the frames, a millimetre apart and more."""
    images = np.random.default_rng(1).integers(0, 256, (FRAMES, GRID.vectors, GRID.samples), dtype=np.uint8)
    poses, table = wavering(), []
    for (splat, threads), peer in IGSIO.items():

        def work(splat=splat):
            compound(images, GRID, poses, voxel_grid=VOXELS, splat=splat, fill_radius=0, voxel_type="uint8")

        with on_one_thread() if threads == 1 else nullcontext():
            ours = time_runs(work, runs)
        label, speed = f"{splat} + mean, {threads} thread(s), 8-bit voxels", images.size / ours.seconds / 1e6
        target = TARGETS[splat] if threads == 2 else None
        table.append(Row(label, speed, "Mpixel/s", "IGSIO, elsewhere", peer, target, cores=ours.cores))
    volume = compound(images[::5], GRID, poses[::5], voxel_grid=VOXELS, fill_radius=0)
    voxels, state = volume.voxels.T, volume.state.T
    holes = (state != MEASURED).sum() / 1e6
    seconds = time_runs(lambda: fill_holes(voxels.copy(), state.copy(), 3), runs).seconds
    return [*table, Row(f"{holes:.1f} million holes filled within 3 voxels", holes / seconds, "Mvoxel/s")]
