"""No command writes over what it reads, or over a file of another kind than it writes."""

import shutil

import pytest

SMALLEST = ("--preset", "phantom", "--vectors", 16, "--samples", 600, "--frames", 3, "--length-mm", 1)


@pytest.fixture
def calls(bench, results, tmp_path):
    """Commands by the file that each is to write."""
    shutil.copy(bench / "sweep.h5", tmp_path / "in.h5")
    reconstruction = results / "reconstruction.h5"
    return {
        "s.h5": lambda out: ("simulate", out, *SMALLEST),
        "c.h5": lambda out: ("convert", tmp_path / "in.h5", out),
        "v.nrrd": lambda out: ("volume", reconstruction, "-o", out, "--voxel-mm", 1),
        "r.png": lambda out: ("reslice", reconstruction, "-o", out),
        "o.csv": lambda out: ("imu", "orient", bench / "sweep.h5", "-o", out),
        "p.tum": lambda out: ("trajectory", "export", reconstruction, "-o", out),
    }


def test_other_files_and_inputs_stay_as_they_are(refuse, calls, bench, tmp_path):
    for name, call in calls.items():
        place = tmp_path / name
        place.write_text("precious, 1, 2\n", encoding="utf-8")
        assert str(place) in refuse(*call(place))
        assert place.read_text(encoding="utf-8") == "precious, 1, 2\n"
    before = (tmp_path / "in.h5").read_bytes()
    assert "is an input" in refuse(*calls["c.h5"](tmp_path / "in.h5"))
    assert (tmp_path / "in.h5").read_bytes() == before
    refuse(*calls["v.nrrd"](tmp_path / "w.nrrd"), "--state", tmp_path / "w.nrrd")
    refuse(*calls["r.png"](tmp_path / "cut.xyz"))
    # Below a file there is no folder, and is none made.
    out = tmp_path / "in.h5" / "out"
    curves = bench / "curves.h5"
    line = refuse("reconstruct", tmp_path / "in.h5", "-o", out, "--curves", curves)
    assert "out: expected a folder or a new name, got the file in.h5" in line


@pytest.mark.parametrize("name", ["v.nrrd", "r.png", "o.csv", "p.tum"])
def test_a_command_replaces_its_own_output(run, calls, tmp_path, name):
    for _ in range(2):
        code, _, err = run(*calls[name](tmp_path / name))
        assert code == 0, err
