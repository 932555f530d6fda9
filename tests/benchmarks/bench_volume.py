"""Speed of making voxels of frames, beside others in the same process.

Run: ``python tests/benchmarks/bench_volume.py [--runs 5]`` on a quiet machine. Needs SimpleITK. 300 frames of
640 x 480 pixels of 0.1 mm, 8 bits each, of a sweep that wavers go into 273 x 193 x 240 voxels of 0.25 mm.
A ``!`` marks a target that is missed.

Beside it, on the same frames and voxels:

- SimpleITK: the frames taken for one stack of parallel planes, which they are not, resampled to the voxels,
  linearly; backward, so that it looks at each voxel and not at each pixel.
- IGSIO, the reconstruction inside PLUS and 3D Slicer, was built and timed elsewhere, on a machine of two
  cores like the one that the README's figures are from; it is not run here.
"""

import argparse
import os
import sys
import time
from contextlib import nullcontext
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import SimpleITK as sitk
from scipy.spatial.transform import RigidTransform, Rotation
from speed.rows import Row, print_table, timed

from speckle3d.core.grid import ImageGrid
from speckle3d.core.labels import MEASURED
from speckle3d.core.threads import cores, on_one_thread
from speckle3d.imaging.voxels.grid import VoxelGrid
from speckle3d.imaging.voxels.holes import fill_holes
from speckle3d.imaging.voxels.volume import compound

GRID = ImageGrid(640, 480, 0.1, 0.1)
VOXELS = VoxelGrid((273, 193, 240), (0.25, 0.25, 0.25), RigidTransform.identity())
FRAMES = 300
TARGETS = {"nearest": 400, "linear": 120}
IGSIO = {("nearest", 1): 172, ("nearest", 2): 207, ("linear", 1): 15, ("linear", 2): 28}
"""Million pixels per second, with the mean, by threads: IGSIO of 2024, measured elsewhere."""


def sweep(frames, length_mm):
    """Poses along the voxels' k axis, wavering."""
    rng = np.random.default_rng(0)
    turned = Rotation.from_rotvec(0.03 * np.sin(np.linspace(0, 9, frames))[:, None] * rng.normal(size=3))
    along = np.linspace(1.5, 1.5 + length_mm, frames) + rng.normal(0, 0.02, frames)
    moved = np.column_stack([np.full(frames, 2.0), np.full(frames, 0.2), along])
    return RigidTransform.from_components(moved, turned)


def ours(images, poses, runs):
    rows = []
    for splat in ("nearest", "linear"):

        def work(splat=splat):
            compound(images, GRID, poses, voxel_grid=VOXELS, splat=splat, fill_radius=0, voxel_type="uint8")

        for threads in (1, 2):
            with on_one_thread() if threads == 1 else nullcontext():
                timing = timed(work, runs)
            rows.append(
                Row(
                    f"{splat} + mean, {min(threads, cores())} thread(s), 8-bit voxels",
                    images.size / timing.seconds / 1e6,
                    "Mpixel/s",
                    f"IGSIO {threads} thread(s), elsewhere",
                    IGSIO[splat, threads],
                    target=TARGETS[splat] if threads == 2 else None,
                    cores=timing.cores,
                )
            )
    return rows


def beside_simpleitk(images, poses, runs):
    best = timed(
        lambda: compound(images, GRID, poses, voxel_grid=VOXELS, fill_radius=0, voxel_type="uint8"), runs
    )
    value, peer = (images.size / seconds / 1e6 for seconds in (best.seconds, by_simpleitk(images, poses)))
    return Row("nearest + mean", value, "Mpixel/s", "SimpleITK resample of a stack", peer, cores=best.cores)


def by_simpleitk(images, poses):
    began = time.perf_counter()
    stack = sitk.GetImageFromArray(images)
    step = float(np.diff(poses.translation[:, 2]).mean())
    stack.SetSpacing((GRID.sample_spacing_mm, GRID.vector_pitch_mm, step))
    stack.SetOrigin(poses[0].translation[[1, 0, 2]])
    n_i, n_j, n_k = VOXELS.shape
    sitk.Resample(stack, (n_j, n_i, n_k), sitk.Transform(), sitk.sitkLinear, (0, 0, 0), VOXELS.spacing_mm)
    return time.perf_counter() - began


def filling(images, poses, runs):
    """Holes of a third of the frames, a millimetre apart and more."""
    volume = compound(images[::5], GRID, poses[::5], voxel_grid=VOXELS, fill_radius=0)
    voxels, state = volume.voxels.T, volume.state.T
    holes = int((state != MEASURED).sum())
    seconds = timed(lambda: fill_holes(voxels.copy(), state.copy(), 3), runs).seconds
    return Row(f"{holes / 1e6:.1f} million holes filled within 3 voxels", holes / seconds / 1e6, "Mvoxel/s")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    images = np.random.default_rng(1).integers(0, 256, (FRAMES, GRID.vectors, GRID.samples), dtype=np.uint8)
    poses = sweep(FRAMES, 56.0)
    rows = [
        *ours(images, poses, options.runs),
        beside_simpleitk(images, poses, options.runs),
        filling(images, poses, options.runs),
    ]
    print_table(rows)


if __name__ == "__main__":
    main()
