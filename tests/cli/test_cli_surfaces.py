"""`speckle3d measure` and `speckle3d surface` on a ball whose size is known."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from speckle3d.core.volume import Volume
from speckle3d.io.shapes import read_surface
from speckle3d.io.voxels.volumes import write_volume

RADIUS_MM, STEP_MM = 3.0, 0.25
VOLUME_MM3 = 4 / 3 * np.pi * RADIUS_MM**3


@pytest.fixture
def ball(tmp_path):
    index = np.moveaxis(np.indices((41, 41, 41)), 0, -1) * STEP_MM
    depth = RADIUS_MM - np.linalg.norm(index - 5.0, axis=-1)
    grey = np.clip(128 + 100 * depth / STEP_MM, 1, 255).astype(np.uint8)
    path = tmp_path / "ball.nrrd"
    write_volume(path, Volume(grey, (STEP_MM,) * 3, RigidTransform.identity(), {"poses": "image"}))
    return path


def test_distances_have_the_errors_of_poses_and_picks(run, results):
    points = ("--point", "3,5,0.5", "--point", "3,5,2.5", "--point", "6,5,2.5", "--mode", "image")
    measure = ("measure", results / "reconstruction.h5", *points, "--pick-mm", "0.05")
    code, out, err = run(*measure, "--json")
    assert code == 0, err
    first, _, line, angle = json.loads(out)["measurements"]
    assert first["value"] == pytest.approx(2.0)
    assert first["by_picking"] == pytest.approx(0.05 * np.sqrt(2))
    # Curves of one small phantom sweep leave 8 % open.
    assert 0.02 < first["by_poses"] / 2.0 < 0.2
    assert (line["value"], angle["value"]) == pytest.approx((5.0, 90.0))
    assert run(*measure)[1].startswith(f"distance 1 2: 2.00 +- {1.96 * first['standard_error']:.2f} mm (95 %")


def test_grey_levels_are_no_labels(refuse, tmp_path):
    path, grey = tmp_path / "grey.nrrd", np.arange(216, dtype=np.uint8).reshape(6, 6, 6)
    write_volume(path, Volume(grey, (1.0, 1.0, 1.0), RigidTransform.identity()))
    assert "got 216 values" in refuse("surface", path, "-o", tmp_path / "s.stl", "--labels")


def test_a_ball_has_its_volume(run, ball, tmp_path):
    out = tmp_path / "ball.ply"
    code, text, err = run("surface", ball, "-o", out, "--level", "128", "--json")
    assert code == 0, err
    (sizes,) = json.loads(text)
    assert sizes["volume_mm3"] == pytest.approx(VOLUME_MM3, rel=0.01)
    assert sizes["open_mm"] == 0.0
    assert len(read_surface(out)) == sizes["triangles"]
