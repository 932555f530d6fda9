"""Volumes of a real tracked sweep beside those that PLUS made of it.

With the rule "plus" they are PLUS's to the last voxel.
"""

import re
from dataclasses import dataclass
from functools import cached_property
from unittest import mock

import igsio_twin
import numpy as np
import pytest
from igsio_twin import Clip
from scipy.spatial.transform import RigidTransform

from speckle3d.core.grid import ImageGrid
from speckle3d.core.labels import MEASURED
from speckle3d.imaging.images import PosedImages
from speckle3d.imaging.voxels.grid import VoxelGrid
from speckle3d.imaging.voxels.splatting import splat_images

pytestmark = pytest.mark.realdata

SPACING_MM = 0.5
WIDTH, HEIGHT = 820, 616

CLIPS = {"NN": Clip((0, 820), (0, 616)), "LN": Clip((192, 612), (16, 596), (380, 20, 120, 360, -45, 45))}
"""Of ``PlusDeviceSet_VolumeReconstructionOnly_SpinePhantom_NN_MEAN`` and ``..._SonixRP_TRUS_D70mm_LN_MEAN``,
which its tests make the two volumes with; the second's fan is that of ``..._NN_LATE``."""


@dataclass
class Case:
    """A volume of PLUS, the images it was made of, and where they lie in it."""

    name: str
    images: np.ndarray
    reference: np.ndarray
    header_origin: np.ndarray
    reference_from_image: np.ndarray

    @property
    def clip(self):
        return CLIPS[self.name]

    @property
    def splat(self):
        return "linear" if self.name == "LN" else "nearest"

    @cached_property
    def own_grid(self):
        """Origin of PLUS's grid and its shape: the header has six digits of the origin."""
        return igsio_twin.grid_of(self.reference_from_image, self.clip, WIDTH, HEIGHT, SPACING_MM)

    @property
    def maps(self):
        """Affine maps from (column, row, 0, 1) to voxel indices."""
        maps = self.reference_from_image[:, :3].copy()
        maps[:, :, 3] -= self.own_grid[0]
        return maps / SPACING_MM

    @cached_property
    def pasted(self):
        """Volume without filled holes, and which voxels are measured, both [i, j, k]."""
        shape = self.own_grid[1]
        still = RigidTransform.from_translation(np.zeros((len(self.images), 3)))
        source = PosedImages(self.images.transpose(0, 2, 1), ImageGrid(WIDTH, HEIGHT, 1.0, 1.0), still)
        grid = VoxelGrid(shape, (SPACING_MM,) * 3, RigidTransform.identity())
        where, mask = "speckle3d.imaging.voxels.splatting.index_from_sample", self.clip.mask(WIDTH, HEIGHT).T
        with mock.patch(where, return_value=self.maps[:, :, [0, 1, 3]]):
            voxels, state = splat_images(source, grid, self.splat, "plus", mask=mask)
        return voxels.T, state.T == MEASURED


def matrix(text):
    return np.array(text.split(), dtype=float).reshape(4, 4)


def device_set(folder):
    return folder / "PlusDeviceSet_VolumeReconstructionOnly_SpinePhantom_NN_MEAN.xml"


def reference_path(folder, name):
    return folder / f"vtkVolumeReconstructorTest{name}MEANvolumeRef.mha"


@pytest.fixture(scope="module", params=["NN", "LN"])
def case(request, realdata):
    sitk, folder = pytest.importorskip("SimpleITK"), realdata / "plus"
    config = device_set(folder).read_text()
    sweep = sitk.ReadImage(folder / "SpinePhantomFreehand.igs.mha")
    plus = sitk.ReadImage(reference_path(folder, request.param))
    images = sitk.GetArrayFromImage(sweep)
    held = [f"Seq_Frame{i:04d}_{{}}ToTrackerTransform" for i in range(len(images))]
    probe, reference = (
        np.array([matrix(sweep.GetMetaData(name.format(tool))) for name in held])
        for tool in ("Probe", "Reference")
    )
    probe_from_image = matrix(re.search(r'From="Image" To="Probe"\s+Matrix="([^"]*)"', config)[1])
    voxels = sitk.GetArrayFromImage(plus).transpose(2, 1, 0)
    placed = np.linalg.inv(reference) @ probe @ probe_from_image
    return Case(request.param, images, voxels, np.array(plus.GetOrigin()), placed)


def test_the_rule_plus_makes_the_volumes_of_plus_to_the_last_voxel(case):
    """At the poses as written, and on PLUS's grid before its header was."""
    origin, shape = case.own_grid
    np.testing.assert_allclose(origin, case.header_origin, atol=6e-4)
    assert shape == case.reference.shape
    volume, measured = case.pasted
    assert measured.sum() > 1e5
    np.testing.assert_array_equal(volume[measured], case.reference[measured])
