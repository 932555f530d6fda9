"""The reconstruction viewer without a browser."""

import numpy as np
import pytest
from commands import run_command
from scipy.spatial.transform import RigidTransform

from speckle3d.app.reconstruction.page import ReconstructionPage, _Viewer
from speckle3d.core.grid import ImageGrid
from speckle3d.core.reconstruction import Provenance, Reconstruction, Trust
from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.io.family.reconstructions import read_reconstruction, write_reconstruction
from speckle3d.io.family.sweep_writer import write_sweep
from speckle3d.io.load import load_sweep, recording_sha256
from speckle3d.io.voxels.volumes import read_volume

GRID = ImageGrid(vectors=32, samples=40, vector_pitch_mm=0.5, sample_spacing_mm=0.5)
FRAMES = 24


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A sweep of smooth speckle with two modes, of which one is 5 % longer."""
    folder = tmp_path_factory.mktemp("smooth")
    z = 0.4 * np.arange(FRAMES)
    x, y = np.meshgrid(np.arange(32) * 0.5, np.arange(40) * 0.5, indexing="ij")
    images = [128 + 60 * np.sin(x / 2 + 0.3 * k) * np.cos(y / 3 + 0.1 * k) for k in range(FRAMES)]
    sweep = Sweep(
        np.rint(images).astype(np.uint8), GRID, BModeSettings(dynamic_range_db=50.0), z / 10, name="s"
    )
    write_sweep(folder / "s.h5", sweep)
    poses = {
        mode: RigidTransform.from_translation(np.outer(scale * z, [0.0, 0.0, 1.0]))
        for mode, scale in (("image", 1.0), ("pose", 1.05))
    }
    covariance = np.array([np.diag([0.01, 0.02, 0.05 * k + 1e-3, 1e-5, 1e-5, 1e-5]) for k in range(FRAMES)])
    trust = Trust(covariance, np.zeros(FRAMES, dtype=np.int64))
    origin = Provenance("s.h5", recording_sha256(folder / "s.h5"), "")
    write_reconstruction(
        folder / "r.h5", Reconstruction(sweep.frame_time_s, GRID, poses, origin, trust=trust)
    )
    return folder


@pytest.fixture
def viewer(folder):
    viewer = _Viewer(ReconstructionPage(read_reconstruction(folder / "r.h5"), load_sweep(folder / "s.h5")))
    viewer.layout()
    return viewer


@pytest.mark.parametrize(
    ("cut", "mode", "option"),
    [
        ("along", "pose", "--lateral-mm=9"),
        ("frame", "image", "--frame=7"),
        ("depth", "pose", "--depth-mm=11"),
    ],
)
def test_a_cut_is_what_its_command_makes(viewer, folder, cut, mode, option):
    viewer.mode = mode
    viewer.param.update(frame=7, lateral_mm=9.0, depth_mm=11.0)
    run_command("reslice", folder / "r.h5", "-o", folder / f"{cut}.nrrd", "--mode", mode, option)
    levels = read_volume(folder / f"{cut}.nrrd").voxels[..., 0].T.astype(float)
    (pixels,) = viewer._plots[cut].source.data["image"]
    grey = (pixels & 0xFF).astype(float)
    assert levels.shape == grey.shape
    inside = levels > 0
    assert inside.mean() > 0.6
    assert np.abs(grey - (levels - 1) * 255 / 254)[inside].max() < 2.0


def test_points_are_measured_as_their_command_measures(viewer, folder):
    for frame, lateral, depth in ((2, 3.0, 4.0), (18, 9.0, 15.0), (20, 2.0, 8.0)):
        viewer.param.update(frame=frame, lateral_mm=lateral, depth_mm=depth)
        viewer._add()
    points = [f"--point={','.join(map(repr, point.tolist()))}" for point in viewer.points_mm]
    lines = run_command("measure", folder / "r.h5", "--mode", "image", *points).splitlines()
    assert any(line.startswith("distance 1 2: 14.07") for line in lines)
    for line in lines:
        assert line.replace("'", "&#x27;") in viewer._words.object
    viewer.mode = "pose"
    assert viewer.points_mm == []
