"""Modes that set the length: crossing sweeps, inertia, all that is known."""

import json

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.grid import ImageGrid
from speckle3d.core.reconstruction import Provenance, Reconstruction
from speckle3d.io.family.reconstructions import read_reconstruction, write_reconstruction


def test_the_length_of_a_reconstruction_is_that_of_both_ways(run, tmp_path):
    ramp = np.linspace(0.0, 10.0, 51)
    path = RigidTransform.from_translation(np.outer([*ramp, *ramp[-2:25:-1]], [0.0, 0.0, 1.0]))
    grid = ImageGrid(48, 1024, 0.3, 0.04)
    times = np.arange(len(path)) / 25.0
    made = Reconstruction(times, grid, {"image": path}, Provenance("sweep.h5", "", ""))
    write_reconstruction(tmp_path / "r.h5", made)
    rows = {
        row["description"]: row["value"] for row in json.loads(run("info", tmp_path / "r.h5", "--json")[1])
    }
    assert rows["length, mode image"] == "14.80"


def test_sweeps_that_do_not_cross_leave_the_mode_out_and_keep_the_others(run, bench, tmp_path):
    sweep, folder = bench / "sweep.h5", tmp_path
    new_curves = folder / "saved.h5"
    code, out, err = run(
        *("reconstruct", sweep, "--frames", "0-11", "--crossing-frames", "12-23", "-o", folder / "crossed"),
        *("--drift", "fused", "--drift", "crossed", "--save-curves", new_curves, "--json"),
    )
    assert code == 2, err
    (summary,) = json.loads(out)["sweeps"]
    assert summary["frames"] == 12
    assert {row["mode"] for row in summary["rows"]} == {"image", "fused", "tracker"}
    assert list(summary["left_out"]) == ["crossed"]
    assert summary["claims"]["image"] > summary["claims"]["fused"] > 0
    assert "drift mode crossed: " in err.strip().splitlines()[-1]
    assert not new_curves.exists()
    assert list(read_reconstruction(folder / "crossed" / "reconstruction.h5").poses) == ["image", "fused"]
