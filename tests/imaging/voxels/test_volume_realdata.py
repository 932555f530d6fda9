"""Volumes of a real tracked sweep by the rule "plus" beside those that PLUS made of it."""

import re
from unittest import mock

import numpy as np
import pytest
from igsio_twin import Clip, grid_of
from scipy.spatial.transform import RigidTransform

from speckle3d.core.grid import ImageGrid
from speckle3d.core.volume import MEASURED
from speckle3d.imaging.images import PosedImages
from speckle3d.imaging.voxels.grid import VoxelGrid
from speckle3d.imaging.voxels.splatting import splat_images

pytestmark = pytest.mark.realdata

SPACING_MM = 0.5
WIDTH, HEIGHT = 820, 616
NEAREST = Clip((0, 820), (0, 616))
"""Of ``PlusDeviceSet_VolumeReconstructionOnly_SpinePhantom_NN_MEAN``, of PLUS's tests."""
LINEAR = Clip((192, 612), (16, 596), (380, 20, 120, 360, -45, 45))
"""Of ``..._SonixRP_TRUS_D70mm_LN_MEAN``; its fan is that of ``..._NN_LATE``."""


def matrix(text):
    return np.array(text.split(), dtype=float).reshape(4, 4)


@pytest.mark.parametrize(
    ("name", "splat", "clip"), [("NN", "nearest", NEAREST), ("LN", "linear", LINEAR)], ids=["NN", "LN"]
)
def test_the_rule_plus_makes_the_volumes_of_plus_to_the_last_voxel(realdata, name, splat, clip):
    """At the poses as written, and on PLUS's grid before its header was."""
    sitk, folder = pytest.importorskip("SimpleITK"), realdata / "plus"
    config = (folder / "PlusDeviceSet_VolumeReconstructionOnly_SpinePhantom_NN_MEAN.xml").read_text()
    sweep = sitk.ReadImage(folder / "SpinePhantomFreehand.igs.mha")
    plus = sitk.ReadImage(folder / f"vtkVolumeReconstructorTest{name}MEANvolumeRef.mha")
    images = sitk.GetArrayFromImage(sweep)
    keys = [f"Seq_Frame{i:04d}_{{}}ToTrackerTransform" for i in range(len(images))]
    probe, reference = (
        np.array([matrix(sweep.GetMetaData(key.format(tool))) for key in keys])
        for tool in ("Probe", "Reference")
    )
    probe_from_image = matrix(re.search(r'From="Image" To="Probe"\s+Matrix="([^"]*)"', config)[1])
    reference_from_image = np.linalg.inv(reference) @ probe @ probe_from_image
    origin, shape = grid_of(reference_from_image, clip, WIDTH, HEIGHT, SPACING_MM)
    # The header has six digits of the origin.
    np.testing.assert_allclose(origin, plus.GetOrigin(), atol=6e-4)
    expected = sitk.GetArrayFromImage(plus)
    assert shape == expected.shape[::-1]
    maps = reference_from_image[:, :3, [0, 1, 3]] - np.multiply.outer(origin, [0, 0, 1])
    still = RigidTransform.from_translation(np.zeros((len(images), 3)))
    source = PosedImages(images.transpose(0, 2, 1), ImageGrid(WIDTH, HEIGHT, 1.0, 1.0), still)
    grid, mask = VoxelGrid(shape, (SPACING_MM,) * 3, RigidTransform.identity()), clip.mask(WIDTH, HEIGHT).T
    where = "speckle3d.imaging.voxels.splatting.index_from_sample"
    with mock.patch(where, return_value=maps / SPACING_MM):
        voxels, state = splat_images(source, grid, splat, "plus", mask=mask)
    assert (state == MEASURED).sum() > 1e5
    np.testing.assert_array_equal(voxels[state == MEASURED], expected[state == MEASURED])
