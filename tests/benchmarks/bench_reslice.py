"""Reslicing straight from frames and compounding, against SciPy on the same scene in the same process.

Run: ``pytest tests/benchmarks/bench_reslice.py --benchmark-only -s``. Each prints Mpixel/s and a ratio.
"""

import time

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.sweep import ImageGrid
from speckle3d.imaging.planes import along_sweep_plane, surface_plane
from speckle3d.imaging.reslice import reslice_frames
from speckle3d.imaging.volume import compound

GRID = ImageGrid(127, 1000, 0.3, 0.04)
FRAMES, STEP_MM, PIXEL_MM = 200, 0.15, 0.05


@pytest.fixture(scope="module")
def sweep():
    rng = np.random.default_rng(0)
    images = rng.random((FRAMES, GRID.vectors, GRID.samples), dtype=np.float32)
    moved = np.outer(np.arange(FRAMES) * STEP_MM, [0, 0, 1]) + rng.normal(0, 0.05, (FRAMES, 3))
    turned = Rotation.from_rotvec(rng.normal(0, 0.005, (FRAMES, 3)))
    return images, RigidTransform.from_components(moved, turned)


def seconds(function, *arguments, rounds=3, **keywords):
    """Least time of a few rounds after one to compile and warm up."""
    function(*arguments, **keywords)
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        function(*arguments, **keywords)
        times.append(time.perf_counter() - start)
    return min(times)


@pytest.mark.parametrize("make_plane", [along_sweep_plane, surface_plane])
def test_reslice_against_map_coordinates_on_voxels(benchmark, sweep, make_plane):
    images, poses = sweep
    plane = make_plane(poses, GRID, 15.0, PIXEL_MM)
    volume = compound(images, GRID, poses, 0.2)
    to_index = np.linalg.solve(volume.world_from_index, plane.world_from_pixel())[:3]

    def from_voxels():
        rows, columns = np.indices(plane.shape)
        index = np.einsum("ij,j...->i...", to_index, np.stack([columns, rows, np.ones_like(rows)]))
        return map_coordinates(volume.voxels, index, order=1, cval=np.nan)

    benchmark(reslice_frames, images, GRID, poses, plane, 0.5)
    ours, theirs = (
        seconds(reslice_frames, images, GRID, poses, plane, 0.5),
        seconds(from_voxels),
    )
    mpixel = np.prod(plane.shape) / 1e6
    print(
        f"\n{make_plane.__name__}: {mpixel:.2f} Mpixel from {FRAMES} frames at {mpixel / ours:.1f} Mpixel/s, "
        f"map_coordinates on ready voxels {mpixel / theirs:.1f} Mpixel/s: {theirs / ours:.2f} times its speed"
    )


def test_compound_against_numpy_bincount(benchmark, sweep):
    images, poses = sweep
    volume = compound(images, GRID, poses, 0.2, fill_radius=0)
    grid_from_image = volume.world_from_grid.inv() * poses
    i, j = np.mgrid[: GRID.vectors, : GRID.samples]
    local = np.stack([i * GRID.vector_pitch_mm, j * GRID.sample_spacing_mm, np.zeros(i.shape)], axis=-1)

    def by_numpy():
        total, count = np.zeros((2, volume.voxels.size))
        for image, pose in zip(images, grid_from_image, strict=True):
            index = np.rint(pose.apply(local.reshape(-1, 3)) / 0.2).astype(np.int64)
            flat = np.ravel_multi_index(tuple(index.T), volume.shape, mode="clip")
            np.add.at(total, flat, image.ravel())
            np.add.at(count, flat, 1)
        return total / np.maximum(count, 1)

    benchmark(compound, images, GRID, poses, 0.2, fill_radius=0)
    ours = seconds(compound, images, GRID, poses, 0.2, fill_radius=0)
    filled = seconds(compound, images, GRID, poses, 0.2)
    theirs = seconds(by_numpy, rounds=1)
    mpixel = images.size / 1e6
    print(
        f"\ncompound: {mpixel / ours:.0f} Mpixel/s into {volume.voxels.size / 1e6:.1f} Mvoxel "
        f"({mpixel / filled:.0f} with holes filled), NumPy {mpixel / theirs:.1f} Mpixel/s: "
        f"{theirs / ours:.1f} times its speed"
    )
