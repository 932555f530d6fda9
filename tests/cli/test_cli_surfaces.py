"""`speckle3d measure` and `speckle3d surface` on a ball whose size is known."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from speckle3d.core.grid import ImageGrid
from speckle3d.core.reconstruction import Provenance, Reconstruction, SharedErrors, Trust
from speckle3d.core.volume import Volume
from speckle3d.io.reconstructions import write_reconstruction
from speckle3d.io.shapes.surfaces import read_surface
from speckle3d.io.voxels.volume_writer import write_volume
from speckle3d.motion.uncertainty import shared_covariance

GRID = ImageGrid(51, 51, 0.2, 0.2)
N = 41
POSES = RigidTransform.from_translation(np.column_stack([np.zeros((N, 2)), 0.25 * np.arange(N)]))
SCALE = SharedErrors(0.0, 0.05, np.zeros(2))
RADIUS_MM, STEP_MM = 3.0, 0.25
VOLUME_MM3 = 4 / 3 * np.pi * RADIUS_MM**3


@pytest.fixture
def rec(tmp_path):
    """A reconstruction whose scale is known to 5 %."""
    path = tmp_path / "reconstruction.h5"
    covariance = shared_covariance(POSES, GRID.centre_mm, SCALE)
    trust, made = Trust(covariance, np.zeros(N, dtype=np.int64), SCALE), Provenance("sweep.h5", "", "")
    held = Reconstruction(0.04 * np.arange(N), GRID, {"image": POSES}, made, trust=trust)
    write_reconstruction(path, held)
    return path


@pytest.fixture
def ball(tmp_path):
    index = np.moveaxis(np.indices((41, 41, 41)), 0, -1) * STEP_MM
    depth = RADIUS_MM - np.linalg.norm(index - 5.0, axis=-1)
    grey = np.clip(128 + 100 * depth / STEP_MM, 1, 255).astype(np.uint8)
    path = tmp_path / "ball.nrrd"
    write_volume(path, Volume(grey, (STEP_MM,) * 3, RigidTransform.identity(), {"poses": "image"}))
    return path


def test_a_distance_along_the_sweep_is_as_sure_as_its_scale(run, rec):
    points = ("--point", "5,5,1", "--point", "5,5,9", "--point", "9,5,9")
    code, out, err = run("measure", rec, *points, "--pick-mm", "0.05", "--json")
    assert code == 0, err
    told = json.loads(out)
    first, second, line, angle = told["measurements"]
    assert first["value"] == pytest.approx(8.0)
    assert first["by_poses"] == pytest.approx(0.05 * 8.0, rel=1e-3)
    assert first["by_picking"] == pytest.approx(0.05 * np.sqrt(2))
    assert first["interval_95"][1] == pytest.approx(8.0 + 1.959964 * first["standard_error"])
    # Across the sweep the scale along it does nothing.
    assert second["by_poses"] == pytest.approx(0.0, abs=1e-6)
    assert line["value"] == pytest.approx(12.0)
    assert angle["value"] == pytest.approx(90.0)
    _, out, _ = run("measure", rec, *points, "--pick-mm", "0.05")
    assert out.splitlines()[0].startswith("distance 1 2: 8.00 +- 0.41 mm [7.20, 8.80]")


def test_a_ball_has_its_volume_and_what_the_scale_does_to_it(run, ball, rec, tmp_path):
    out = tmp_path / "ball.ply"
    code, text, err = run("surface", ball, "-o", out, "--level", "128", "--reconstruction", rec, "--json")
    assert code == 0, err
    (told,) = json.loads(text)
    assert told["volume_mm3"] == pytest.approx(VOLUME_MM3, rel=0.01)
    assert told["volume_sigma_mm3"] == pytest.approx(0.05 * told["volume_mm3"], rel=0.01)
    assert told["open_mm"] == 0.0
    surface = read_surface(out)
    assert len(surface) == told["triangles"]
    np.testing.assert_allclose(surface.vertices_mm.mean(axis=0), 5.0, atol=0.01)
