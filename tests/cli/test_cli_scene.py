"""What a reconstruction gives 3D Slicer: transforms, a sequence, a scene."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from speckle3d.io.voxels.volumes import read_volume

DEVIATION_AND_STATE = (("deviation", ".nrrd"), ("state", ".seg.nrrd"))


@pytest.fixture
def reconstruction(results):
    return results / "reconstruction.h5"


def test_a_scene_of_two_modes(run, refuse, reconstruction, tmp_path):
    target = tmp_path / "scene"
    options = ("--mode", "image", "--mode", "pose", "--voxel-mm", 0.5, "--deviation")
    code, out, err = run("scene", reconstruction, "-o", target, *options)
    assert (code, out) == (0, ""), err
    names = {node.get("name") for node in ElementTree.parse(target / "scene.mrml").getroot()}
    assert {"sweep, image", "sweep, pose", "sweep, image: outlines"} <= names
    assert read_volume(target / "volume-pose.nrrd").fields["poses"] == "pose"
    deviation, state = (read_volume(target / f"{name}-pose{end}") for name, end in DEVIATION_AND_STATE)
    np.testing.assert_array_equal(np.isfinite(deviation.voxels), state.voxels > 0)
    assert np.nanmin(deviation.voxels) >= 0
    assert run("scene", reconstruction, "-o", target, "--voxel-mm", 0.5)[0] == 0
    assert not (target / "volume-pose.nrrd").exists()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "volume-pose.nrrd").write_text("precious")
    assert "another origin" in refuse("scene", reconstruction, "-o", tmp_path / "other")
    assert "is an input" in refuse("scene", target / "scene.mrml", "-o", target)
