"""Filling of holes, and voxels looked up between sparse images, against SciPy in the same process.

Run: ``pytest tests/benchmarks/bench_holes.py --benchmark-only -s``. Each prints million voxels/s and a ratio.
"""

import time

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.spatial.transform import RigidTransform

from speckle3d.core.labels import MEASURED
from speckle3d.core.sweep import ImageGrid
from speckle3d.imaging.images import PosedImages
from speckle3d.imaging.voxels.backward import look_up_voxels
from speckle3d.imaging.voxels.grid import VoxelGrid
from speckle3d.imaging.voxels.holes import fill_holes

SHAPE = (240, 193, 273)


def seconds(function, rounds=3):
    """Least time of a few rounds."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_holes_against_the_nearest_voxel_by_a_distance_transform(benchmark, share):
    rng = np.random.default_rng(0)
    voxels = rng.uniform(0, 255, SHAPE).astype(np.float32)
    measured = (rng.random(SHAPE) > share).astype(np.uint8)

    def ours():
        # The state, which filling changes, is copied each time, and counts.
        fill_holes(voxels, measured.copy(), 3)

    def theirs():
        nearest = distance_transform_edt(measured != MEASURED, return_distances=False, return_indices=True)
        return voxels[tuple(nearest)]

    benchmark(ours)
    mine, other = seconds(ours), seconds(theirs, 1)
    print(
        f"\n{share:.0%} holes: {np.prod(SHAPE) / mine / 1e6:.0f} million voxels/s, {other / mine:.0f} times "
        "as fast as SciPy's distance transform takes the nearest voxel"
    )


def test_backward_against_map_coordinates_on_a_stack_of_images(benchmark):
    # Parallel images, which SciPy can interpolate: ours takes any poses.
    grid, step_mm = ImageGrid(640, 480, 0.1, 0.1), 1.0
    images = np.random.default_rng(0).integers(0, 255, (61, 640, 480)).astype(np.float32)
    poses = RigidTransform.from_translation(np.outer(np.arange(61) * step_mm, [0, 0, 1]))
    voxels = VoxelGrid(SHAPE[::-1], (0.234, 0.248, 0.25), RigidTransform.identity())
    source = PosedImages(images, grid, poses)

    def ours():
        return look_up_voxels(source, voxels, 1.5 * step_mm)

    def theirs():
        k, j, i = np.indices(SHAPE, dtype=np.float32)
        return map_coordinates(images, [k * 0.25 / step_mm, i * 2.34, j * 2.48], order=1, cval=np.nan)

    benchmark(ours)
    mine, other = seconds(ours), seconds(theirs, 1)
    print(
        f"\nbackward: {np.prod(SHAPE) / mine / 1e6:.0f} million voxels/s, {other / mine:.1f} times as fast "
        "as SciPy's map_coordinates on the images as a stack"
    )
