"""Modes that set the length: crossing sweeps, inertia, all that is known."""

import json

import pytest

from speckle3d.io.load import load_sweep
from speckle3d.io.reconstructions import read_reconstruction

CURVES = "curves.h5"


@pytest.fixture(scope="module")
def parts(bench, tmp_path_factory):
    """Both halves of the small sweep as a pair that does not cross, and the first frames reconstructed."""
    return bench / "sweep.h5", tmp_path_factory.mktemp("parts")


def test_sweeps_that_do_not_cross_leave_the_mode_out_and_keep_the_others(run, parts):
    sweep, folder = parts
    saved = folder / "saved.h5"
    code, out, err = run(
        *("reconstruct", sweep, "--frames", "0-11", "--crossing-frames", "12-23", "-o", folder / "crossed"),
        *("--drift", "fused", "--drift", "crossed", "--save-curves", saved, "--json"),
    )
    assert code == 2, err
    (held,) = json.loads(out)["sweeps"]
    assert held["frames"] == 12
    assert {row["mode"] for row in held["rows"]} == {"image", "fused", "tracker"}
    assert list(held["left_out"]) == ["crossed"]
    assert held["claims"]["image"] > held["claims"]["fused"] > 0
    last = err.strip().splitlines()[-1]
    assert "drift mode crossed: " in last
    assert "expected" in last
    assert f"{saved}: not written" in err
    assert not saved.exists()
    found = read_reconstruction(folder / "crossed" / "reconstruction.h5")
    assert list(found.poses) == ["image", "fused"]
    assert found.provenance.crossing.path.endswith("sweep.h5")
    assert found.frame_time_s.tolist() == load_sweep(sweep).frame_time_s[:12].tolist()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--frames", "5-99"), "5 to 99"),
        (("--drift", "crossed"), "drift mode crossed: expected a crossing sweep (--crossing SWEEP)"),
    ],
)
def test_what_makes_no_pair_is_refused(refused, bench, tmp_path, options, words):
    assert words in refused("reconstruct", bench / "sweep.h5", "-o", tmp_path / "out", *options)
