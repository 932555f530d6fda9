"""What a reconstruction gives 3D Slicer: transforms, a sequence, a scene."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from speckle3d.io.headers import read_header
from speckle3d.io.reconstructions import read_reconstruction
from speckle3d.io.voxels.volumes import read_volume

DEVIATION_AND_STATE = (("deviation", ".nrrd"), ("state", ".seg.nrrd"))


@pytest.fixture
def made(reconstructed):
    return reconstructed / "reconstruction.h5"


def test_a_reconstruction_becomes_a_sequence_with_its_poses(run, made, tmp_path):
    name = "s.seq.nrrd"
    code, out, err = run("convert", made, tmp_path / name, "--mode", "orientation")
    assert (code, out) == (0, ""), err
    header = read_header(tmp_path / name)
    assert (header.size, header.transforms) == ((26, 600, 24), ["ImageToWorld"])
    pose = read_reconstruction(made).poses["orientation"][11]
    matrix = np.reshape([float(x) for x in header.frames[11]["ImageToWorldTransform"].split()], (4, 4))
    np.testing.assert_allclose(matrix[:3, 3] * [-1, -1, 1], pose.apply([0, 0, 0]), atol=1e-6)


def test_a_scene_of_two_modes(run, refused, made, tmp_path):
    target = tmp_path / "scene"
    options = ("--mode", "image", "--mode", "pose", "--voxel-mm", 0.5, "--deviation")
    code, out, err = run("scene", made, "-o", target, *options)
    assert (code, out) == (0, ""), err
    names = {node.get("name") for node in ElementTree.parse(target / "scene.mrml").getroot()}
    assert {"sweep, image", "sweep, pose", "sweep, image: outlines"} <= names
    assert read_volume(target / "volume-pose.nrrd").fields["poses"] == "pose"
    assert read_volume(target / "state-pose.seg.nrrd").voxels.max() in (1, 2)
    deviation, state = (read_volume(target / f"{name}-pose{end}") for name, end in DEVIATION_AND_STATE)
    np.testing.assert_array_equal(np.isfinite(deviation.voxels), state.voxels > 0)
    assert np.nanmin(deviation.voxels) >= 0
    assert run("scene", made, "-o", target, "--voxel-mm", 0.5)[0] == 0
    assert not (target / "volume-pose.nrrd").exists()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.txt").write_text("precious")
    assert "another folder" in refused("scene", made, "-o", tmp_path / "other")
