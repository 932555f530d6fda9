"""A folder for 3D Slicer, looked at by what is at hand of its readers: ITK, VTK, slicerio, XML."""

from dataclasses import replace

import numpy as np
import pytest
import SimpleITK
import slicerio
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.imaging.voxels.settings import CompoundingSettings
from speckle3d.study.posed import PosedSweep
from speckle3d.study.scenes.scene import write_scene

NAME = 'Größe <&> "1"; a:b\n'
"""Of a sweep: what XML, attributes of a scene and file systems would stumble over."""


def posed_sweep(mode="image", frames=8):
    rng = np.random.default_rng(2)
    grid = ImageGrid(12, 20, 0.5, 0.25, 1.0)
    images = rng.integers(30, 200, (frames, 12, 20)).astype(np.uint8)
    images[5, 4, 9] = 255  # alone in the sweep
    sweep = Sweep(images, grid, BModeSettings(60.0), 1.0 + 0.04 * np.arange(frames), name=NAME)
    rotation = Rotation.from_euler("yx", [20.0, -35.0], degrees=True)
    along = RigidTransform.from_translation(np.outer(np.arange(frames), [0.0, 0.0, 0.6]))
    poses = RigidTransform.from_components([40.0, -30.0, 20.0], rotation) * along
    return PosedSweep(sweep, np.arange(frames), poses, mode)


SETTINGS = CompoundingSettings(voxel_mm=0.25, splat="nearest")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    target = tmp_path_factory.mktemp("scene") / "a scene"
    pose = replace(posed_sweep("pose"), world_from_image=posed_sweep().world_from_image.inv())
    write_scene(target, [posed_sweep(), pose], SETTINGS, with_images=True)
    return target


def test_volume_labels_outlines_and_pose_are_at_one_place(folder):
    sweep = posed_sweep()
    mark = sweep.world_from_image[5].apply([4 * 0.5, 1.0 + 9 * 0.25, 0.0])
    volume = SimpleITK.ReadImage(str(folder / "volume-image.nrrd"))
    at = volume.TransformPhysicalPointToIndex(mark.tolist())
    # Nearest and mean: the mark shares its voxel with no other sample of twice the voxel's size.
    assert volume.GetPixel(at) == 255
    labels = slicerio.read_segmentation(str(folder / "state-image.seg.nrrd"))
    index = np.rint(np.linalg.solve(labels["ijkToLPS"], [*mark, 1.0])[:3]).astype(int)
    assert tuple(index) == at
    assert labels["voxels"][tuple(index)] == 1
    assert [segment["name"] for segment in labels["segments"]] == ["measured", "filled"]
    pose = SimpleITK.ReadTransform(str(folder / "first-frame-image.tfm"))
    inside = pose.TransformPoint(sweep.world_from_image[0].apply([1.0, 2.0, 0.0]).tolist())
    np.testing.assert_allclose(inside, [1.0, 2.0, 0.0], atol=1e-9)
