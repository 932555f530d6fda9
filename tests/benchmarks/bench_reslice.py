"""Reslicing from voxels and from frames against SciPy in one process.

Run: ``pytest tests/benchmarks/bench_reslice.py --benchmark-only -s``. Each prints its times or Mpixel/s and a
ratio.
"""

import time

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.sweep import ImageGrid
from speckle3d.core.volume import Volume
from speckle3d.imaging.cuts.planes import ReslicePlane, depth_line, lateral_line, planes_from_first_frame
from speckle3d.imaging.cuts.reslice import reslice_frames, reslice_volume
from speckle3d.imaging.voxels.volume import compound

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


@pytest.mark.parametrize("line_of", [lateral_line, depth_line])
def test_reslice_against_map_coordinates_on_voxels(benchmark, sweep, line_of):
    images, poses = sweep
    plane = planes_from_first_frame({"image": poses}, line_of(GRID, 15.0), PIXEL_MM)["image"]
    volume = compound(images, GRID, poses, 0.2)
    benchmark(reslice_frames, images, GRID, poses, plane, 0.5)
    ours, theirs = (
        seconds(reslice_frames, images, GRID, poses, plane, 0.5),
        seconds(by_scipy, volume, plane),
    )
    mpixel = np.prod(plane.shape) / 1e6
    print(
        f"\n{line_of.__name__}: {mpixel:.2f} Mpixel from {FRAMES} frames at {mpixel / ours:.1f} Mpixel/s, "
        f"map_coordinates on ready voxels {mpixel / theirs:.1f} Mpixel/s: {theirs / ours:.2f} times its speed"
    )


SIDE, CUT_SIDE = 256, 512


def by_scipy(volume, plane):
    rows, columns = np.indices(plane.shape)
    world = plane.world_from_mm(columns * plane.pixel_mm, rows * plane.pixel_mm)
    index = volume.world_from_grid.inv().apply(world.reshape(-1, 3)) / volume.spacing_mm
    at = index.T.reshape(3, *plane.shape)
    return map_coordinates(volume.voxels, at, output=np.float32, order=1, cval=np.nan)


@pytest.mark.parametrize("kind", ["uint8", "float32"])
@pytest.mark.parametrize("name", ["across", "oblique"])
def test_reslice_of_voxels_against_scipy(benchmark, kind, name):
    """A cut of 512 x 512 through a volume of 256 x 256 x 256, all of it inside."""
    rng = np.random.default_rng(0)
    voxels = np.asfortranarray(rng.integers(0, 255, (SIDE, SIDE, SIDE)).astype(kind))
    volume = Volume(voxels, (0.5, 0.5, 0.5), RigidTransform.identity())
    turned = Rotation.from_euler("ZYX", [0.0, 0.0, 0.0] if name == "across" else [0.3, -0.4, 0.5])
    half = 40.0
    start = np.full(3, 63.75) - turned.apply([half, half, 0.1])
    placed = RigidTransform.from_components(start, turned)
    plane = ReslicePlane(placed, 2 * half, 2 * half, 2 * half / (CUT_SIDE - 1))
    ours = benchmark(reslice_volume, volume, plane)
    took = seconds(reslice_volume, volume, plane, rounds=9)
    # Single precision of grids and of levels up to 255.
    np.testing.assert_allclose(by_scipy(volume, plane), ours, atol=0.51 if kind == "uint8" else 1e-2)
    theirs = seconds(by_scipy, volume, plane)
    print(
        f"\n{CUT_SIDE} x {CUT_SIDE} {name} from {SIDE}^3 {kind}: {1e3 * took:.2f} ms; "
        f"SciPy {1e3 * theirs:.1f} ms ({theirs / took:.1f} times as long)"
    )
