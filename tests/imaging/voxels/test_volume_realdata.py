"""Volumes of a real tracked sweep beside those that PLUS made of it.

With the rule "plus" they are PLUS's to the last voxel. Of ours by default, bounds are what was measured, with
room for rounding of another machine.
"""

import re
from dataclasses import dataclass
from functools import cached_property
from unittest import mock

import igsio_twin
import numpy as np
import pytest
from commands import run_command
from igsio_twin import Clip
from scipy.spatial.transform import RigidTransform

from speckle3d.core.labels import MEASURED
from speckle3d.core.region import Region
from speckle3d.core.sweep import ImageGrid
from speckle3d.imaging.images import PosedImages
from speckle3d.imaging.voxels.grid import VoxelGrid
from speckle3d.imaging.voxels.splatting import splat_images
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.voxels.volumes import read_volume
from speckle3d.study.posed import open_posed

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


def opened(folder):
    """The recording with its images and poses, as the command opens it."""
    settings = ImportSettings(plus_config=str(device_set(folder)))
    source, meaning = open_posed(folder / "SpinePhantomFreehand.igs.mha", settings=settings).source()
    assert meaning == "B-mode as stored, 0 to 255"
    return source


def share_within(levels, ours, theirs, where):
    return (np.abs(ours[where].astype(float) - theirs[where]) <= levels).mean()


def test_the_rule_plus_makes_the_volumes_of_plus_to_the_last_voxel(case):
    """At the poses as written, and on PLUS's grid before its header was."""
    origin, shape = case.own_grid
    np.testing.assert_allclose(origin, case.header_origin, atol=6e-4)
    assert shape == case.reference.shape
    volume, measured = case.pasted
    assert measured.sum() > 1e5
    np.testing.assert_array_equal(volume[measured], case.reference[measured])


def test_the_command_makes_the_volumes_of_plus(case, realdata, tmp_path):
    folder, out, state = realdata / "plus", tmp_path / "volume.mha", tmp_path / "state.mha"
    fan = ()
    if case.splat == "linear":
        fan = "--splat", "linear", "--region", region_of(case.clip, opened(folder).grid)
    run_command(
        "volume", folder / "SpinePhantomFreehand.igs.mha", "--plus-config", device_set(folder),
        "--like", reference_path(folder, case.name), "--fill-radius", 0, "--rule", "plus", "--state", state,
        *fan, "-o", out,
    )  # fmt: skip
    made, measured = read_volume(out), read_volume(state).voxels == MEASURED
    assert made.fields["rule"] == "plus"
    # The header's origin lacks 0.0005 mm, and poses are made rigid, 0.0001 mm off the written ones.
    assert (measured != case.pasted[1]).mean() < 0.001
    assert share_within(2, made.voxels, case.reference, measured) > 0.998
    assert share_within(0, made.voxels, case.reference, measured) > (0.95 if fan else 0.99)


def region_of(clip, grid):
    """A fan with a part in the middle left out, as a polygon for --region: past both ends of each row."""
    spans = clip.spans(WIDTH, HEIGHT)
    used = np.flatnonzero(spans[:, 0, 0] <= spans[:, 0, 1])
    forked = used[spans[used, 1, 0] <= spans[used, 1, 1]]
    right = [spans[r, int(r in forked), 1] + 0.5 for r in used]
    outline = [*zip(right, used, strict=True), *((spans[r, 0, 0] - 0.5, r) for r in used[::-1])]
    outline += [(spans[r, 0, 1] + 0.5, r) for r in forked]
    outline += [(clip.fan[0], forked[-1] + 0.5), *((spans[r, 1, 0] - 0.5, r) for r in forked[::-1])]
    placed = np.asarray(outline, float) @ grid.image_from_sample[:2, :2].T + grid.image_from_sample[:2, 2]
    text = "polygon " + " ".join(f"{x:.6f},{y:.6f}" for x, y in placed)
    np.testing.assert_array_equal(Region(text).mask(grid), clip.mask(WIDTH, HEIGHT).T)
    return text
