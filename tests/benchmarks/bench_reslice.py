"""Reslicing from voxels and from frames, and compounding, against SciPy, SimpleITK and VTK in one process.

Run: ``pytest tests/benchmarks/bench_reslice.py --benchmark-only -s``. Each prints its times or Mpixel/s and a
ratio. SimpleITK and VTK use the threads that they choose themselves, as many as there are cores.
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
        f"\n{line_of.__name__}: {mpixel:.2f} Mpixel from {FRAMES} frames at {mpixel / ours:.1f} Mpixel/s, "
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


SIDE, CUT_SIDE = 256, 512


def by_scipy(volume, plane):
    rows, columns = np.indices(plane.shape, sparse=True)
    to_index = np.linalg.solve(volume.world_from_index, plane.world_from_pixel())[:3]
    index = np.stack([a * columns + b * rows + c for a, b, c in to_index])
    return map_coordinates(volume.voxels, index, output=np.float32, order=1, cval=np.nan)


def by_itk(volume, plane):
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(volume.voxels.T)
    image.SetSpacing(volume.spacing_mm)
    image.SetOrigin(volume.world_from_grid.translation.tolist())
    image.SetDirection(volume.world_from_grid.rotation.as_matrix().ravel().tolist())
    filter_ = sitk.ResampleImageFilter()
    filter_.SetSize([*plane.shape[::-1], 1])
    filter_.SetOutputSpacing([plane.pixel_mm] * 3)
    filter_.SetOutputOrigin(plane.world_from_plane.translation.tolist())
    filter_.SetOutputDirection(plane.world_from_plane.rotation.as_matrix().ravel().tolist())
    filter_.SetInterpolator(sitk.sitkLinear)
    filter_.SetOutputPixelType(sitk.sitkFloat32)
    return lambda: sitk.GetArrayFromImage(filter_.Execute(image))[0]


def by_vtk(volume, plane):
    vtk = pytest.importorskip("vtk")
    from vtk.util import numpy_support

    data = vtk.vtkImageData()
    data.SetDimensions(volume.shape)
    data.SetSpacing(volume.spacing_mm)
    data.SetOrigin(volume.world_from_grid.translation)
    data.GetPointData().SetScalars(numpy_support.numpy_to_vtk(volume.voxels.T.ravel()))
    reslice = vtk.vtkImageReslice()
    reslice.SetInputData(data)
    reslice.SetOutputDimensionality(2)
    axes = vtk.vtkMatrix4x4()
    axes.DeepCopy(plane.world_from_plane.as_matrix().ravel().tolist())
    reslice.SetResliceAxes(axes)
    reslice.SetOutputSpacing(plane.pixel_mm, plane.pixel_mm, 1.0)
    reslice.SetOutputExtent(0, plane.shape[1] - 1, 0, plane.shape[0] - 1, 0, 0)
    reslice.SetOutputOrigin(0, 0, 0)
    reslice.SetInterpolationModeToLinear()
    reslice.SetOutputScalarType(vtk.VTK_FLOAT)

    def cut():
        reslice.Modified()
        reslice.Update()
        scalars = reslice.GetOutput().GetPointData().GetScalars()
        return numpy_support.vtk_to_numpy(scalars).reshape(plane.shape)

    return cut


@pytest.mark.parametrize("kind", ["uint8", "float32"])
@pytest.mark.parametrize("name", ["across", "oblique"])
def test_reslice_of_voxels_against_scipy_itk_and_vtk(benchmark, kind, name):
    """A cut of 512 x 512 through a volume of 256 x 256 x 256, all of it inside."""
    rng = np.random.default_rng(0)
    voxels = np.asfortranarray(rng.integers(0, 255, (SIDE, SIDE, SIDE)).astype(kind))
    volume = Volume(voxels, (0.5, 0.5, 0.5), RigidTransform.identity())
    turned = Rotation.from_euler("ZYX", [0.0, 0.0, 0.0] if name == "across" else [0.3, -0.4, 0.5])
    half = 40.0
    start = np.full(3, 63.75) - turned.apply([half, half, 0.1])
    placed = RigidTransform.from_components(start, turned)
    plane = ReslicePlane(placed, 2 * half, 2 * half, 2 * half / (CUT_SIDE - 1))
    ways = {
        "scipy": lambda: by_scipy(volume, plane),
        "SimpleITK": by_itk(volume, plane),
        "VTK": by_vtk(volume, plane),
    }
    ours = benchmark(reslice_volume, volume, plane)
    took = seconds(reslice_volume, volume, plane, rounds=9)
    told = []
    for peer, cut in ways.items():
        # Single precision of grids and of levels up to 255.
        np.testing.assert_allclose(cut(), ours, atol=0.51 if kind == "uint8" else 1e-2)
        theirs = seconds(cut, rounds=5)
        told.append(f"{peer} {1e3 * theirs:.1f} ms ({theirs / took:.1f} times as long)")
    print(f"\n{CUT_SIDE} x {CUT_SIDE} {name} from {SIDE}^3 {kind}: {1e3 * took:.2f} ms; {', '.join(told)}")
