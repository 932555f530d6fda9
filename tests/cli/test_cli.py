"""The command line from end to end, on a sweep of 24 small frames."""

import json
import subprocess
import sys

import pytest


def test_the_errors_against_truth_are_in_every_table(results):
    summary = json.loads((results / "summary.json").read_text())["sweeps"][0]
    rows = {row["mode"]: row for row in summary["rows"]}
    assert summary["reference"] == "truth"
    # Three millimetres of a narrow image and a tracker's jitter of 0.15 mm at both ends: loose bounds, which
    # a wrong sign, unit or axis still breaks.
    assert all(abs(row["length_error_percent"]) < 30 for row in rows.values())
    assert abs(rows["orientation"]["tilt_error_deg"]) < 1


def test_without_a_sensor_the_command_says_that_it_assumes_the_sign(run, edit_sweep, tmp_path):
    def forget(file):
        del file["tracker"], file["orientation"], file["truth"]

    code, _, err = run("reconstruct", edit_sweep(forget), "-o", tmp_path / "o")
    assert code == 0
    assert "taken as positive" in err


def test_a_tracker_that_the_images_contradict_leaves_both_lengths(run, edit_sweep, tmp_path):
    def in_metres(file):
        file["tracker/world_from_sensor"][9, :3, 3] = 1e6
        file["tracker/world_from_sensor"][:, :3, 3] *= 1e-3

    out = tmp_path / "o"
    code, table, err = run("reconstruct", edit_sweep(in_metres), "-o", out, "--drift", "pose")
    assert code == 0, err
    assert "poses: 1 of" in err
    summary = json.loads((out / "summary.json").read_text())["sweeps"][0]
    assert "images and tracker" in {doubt["about"] for doubt in summary["doubts"]}
    assert "metres for millimetres" in table
    # There is no best mode: a command that needs one asks for it.
    volume = "volume", out / "reconstruction.h5", "-o", tmp_path / "v.nrrd", "--voxel-mm", "0.5"
    code, _, err = run(*volume)
    assert (code, "expected --mode" in err) == (2, True)
    assert run(*volume, "--mode", "image")[0] == 0


def test_a_tracker_slower_than_the_images_claims_its_jitter(run, edit_sweep, tmp_path):
    def thin(file):
        for name in ("time_s", "world_from_sensor"):
            file["tracker"][name] = file["tracker"].pop(name)[::4]

    assert run("reconstruct", edit_sweep(thin), "-o", tmp_path / "o")[0] == 0
    # The tracker's row is the last.
    *_, row = json.loads((tmp_path / "o/summary.json").read_text())["sweeps"][0]["rows"]
    # 0.15 mm at both ends; on lines between the readings less than 0.03 mm of it shows.
    assert 0.15 < row["sigma_mm"] < 0.6


def test_a_closed_stdout_is_no_error(run, monkeypatch, data_folder):
    monkeypatch.setattr(sys, "stdout", None)
    assert run("info", data_folder / "curves.h5")[0] == 0


@pytest.mark.parametrize("arguments", [(), ("reconstruct", "--help")])
def test_help_is_no_error_and_needs_nothing_heavy(arguments):
    code = "import sys; from speckle3d.cli import main\ntry: main()\nexcept SystemExit: pass\n"
    code += "print(sorted({'numba', 'h5py', 'scipy', 'numpy', 'matplotlib'} & set(sys.modules)))"
    process = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    assert "Usage" in process.stdout
    assert process.stdout.endswith("[]\n")


def test_files_that_are_not_there_or_not_sweeps(refuse, bench, tmp_path):
    out = tmp_path / "o"
    assert "none.h5" in refuse("reconstruct", bench / "none.h5", "-o", out)
    curves = bench / "curves.h5"
    assert "speckle3d.sweep" in refuse("reconstruct", curves, "--curves", curves, "-o", out)
