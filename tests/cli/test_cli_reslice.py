"""``speckle3d reslice``: every place, pictures and volumes, and what is refused."""

import numpy as np
import pytest

from speckle3d.io.load import load_sweep
from speckle3d.io.voxels.volumes import read_volume
from speckle3d.study.reslices.cuts import read_plane


@pytest.fixture
def curve(bench, tmp_path):
    """A curve across the sweep at depth 10, in the true world."""
    truth = load_sweep(bench / "sweep.h5").truth
    points = [truth[frame].apply([x, 10.0, 0.0]) for frame, x in ((0, 1.0), (12, 3.0), (23, 6.0))]
    path = tmp_path / "curve.csv"
    np.savetxt(path, points, delimiter=",", header="x_mm,y_mm,z_mm", comments="", fmt="%.6f")
    return path


def test_a_cut_in_a_frames_plane_lies_there_and_is_that_frame(run, bench, tmp_path):
    sweep = load_sweep(bench / "sweep.h5")
    for name in ("f.nrrd", "f.png"):
        assert run("reslice", bench / "sweep.h5", "-o", tmp_path / name, "--frame", 7)[0] == 0
    plane = read_plane(tmp_path / "f.png")
    x, y = np.array([1.0, 3.0]), np.array([5.0, 20.0])
    expected = sweep.truth[7].apply(np.column_stack([x, y, [0, 0]]))
    np.testing.assert_allclose(plane.world_mm(np.column_stack([x, y])), expected, atol=1e-9)
    volume = read_volume(tmp_path / "f.nrrd")
    assert volume.voxels.mean() > 50
    inside = sweep.truth[7].inv().as_matrix() @ volume.world_from_index
    # Pixels of 0.2 mm along x and y of the image.
    np.testing.assert_allclose(inside[:3, :3], 0.2 * np.eye(3), atol=1e-6)
    assert abs(inside[2, 3]) < 1e-4


def test_along_a_curve_and_along_one_picked_in_a_picture(run, bench, curve, tmp_path):
    cut, top, picks = ("reslice", bench / "sweep.h5", "-o"), tmp_path / "top.png", tmp_path / "picked.csv"
    picks.write_text("x_mm,y_mm\n0.2,1.0\n1.0,2.0\n2.0,2.5\n")
    for out, *options in (
        (tmp_path / "a.png", "--curve", curve),
        (top, "--depth-mm", "10"),
        (tmp_path / "b.png", "--curve", picks, "--on", top),
    ):
        code, _, err = run(*cut, out, *options)
        assert code == 0, err
        assert out.stat().st_size > 10_000
