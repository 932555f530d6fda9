"""Modes that set the length: crossing sweeps, inertia, all that is known."""

import json

from speckle3d.io.reconstructions import read_reconstruction


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
