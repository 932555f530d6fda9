"""Grids of volumes as they are asked for, from the request to the file that other programs read."""

import pytest

from speckle3d.core.grid import Region
from speckle3d.imaging.voxels.settings import CompoundingSettings
from speckle3d.study.posed import open_posed
from speckle3d.study.scenes.voxels import GridRequest, write_voxels

SPACING, ORIGIN, SHAPE = (0.7, 0.9, 1.1), (1.0 / 3.0, 2.0 / 7.0, -0.1), (19, 41, 7)
COARSE = CompoundingSettings(voxel_mm=1.0)


@pytest.fixture(scope="module")
def sweep(data_folder):
    return open_posed(data_folder / "phantom.h5")


def write_image(sweep, path, **request):
    write_voxels(sweep, COARSE, path, **request)
    return pytest.importorskip("SimpleITK").ReadImage(path)


def test_spacing_origin_and_shape_are_in_the_file_to_the_last_bit(sweep, tmp_path):
    name = "v.mha"
    request = GridRequest(axes="world", spacing_mm=SPACING, origin_mm=ORIGIN, shape=SHAPE)
    image = write_image(sweep, tmp_path / name, grid_request=request)
    assert (image.GetSpacing(), image.GetOrigin(), image.GetSize()) == (SPACING, ORIGIN, SHAPE)
    assert image.GetDirection() == (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    again = write_image(sweep, tmp_path / "like.nrrd", grid_request=GridRequest(like=tmp_path / name))
    assert (again.GetSpacing(), again.GetOrigin(), again.GetSize()) == (SPACING, ORIGIN, SHAPE)


def test_a_region_bounds_the_grid_and_what_is_in_it(sweep, tmp_path):
    region = Region("rectangle 3,10 9,20")
    image = write_image(sweep, tmp_path / "v.nrrd", region=region)
    # Images are nearly parallel: the region's 6 x 10 mm, and a voxel or two more that their tilt takes.
    assert image.GetSize()[0] in (7, 8, 9)
    assert image.GetSize()[1] in (11, 12, 13)
    # Voxels of the middle lie in the region as the image beside them has it.
    points = [image.TransformIndexToPhysicalPoint((4, y, 5)) for y in range(2, 9)]
    inside = [sweep.world_from_image[len(sweep.frames) // 2].inv().apply(point)[:2] for point in points]
    assert all(3 < x < 9 and 10 < y < 20 for x, y in inside)
