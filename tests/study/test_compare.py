"""A study of sweeps: every mode, broken sweeps as rows, and only what is missing at a second start."""

import csv
import io
import json
import re
import shutil
from dataclasses import replace

import pytest

from speckle3d.config import Config
from speckle3d.io.family.reconstructions import read_reconstruction
from speckle3d.io.family.sweep_writer import write_sweep
from speckle3d.io.load import load_sweep
from speckle3d.study.compare import compare_sweeps

MODES = ["image", "consistent-subset", "orientation", "pose", "fused", "tracker"]


@pytest.fixture(scope="module")
def sweeps(small_sweeps):
    """Two small sweeps, and one whose file is broken."""
    (small_sweeps / "broken.h5").write_bytes(b"nothing")
    return [small_sweeps / name for name in ("s5.h5", "broken.h5", "s6.h5")]


@pytest.fixture(scope="module")
def study(sweeps, tmp_path_factory):
    return compare_sweeps(sweeps, tmp_path_factory.mktemp("study"))


def read_study(directory):
    return json.loads((directory / "study.json").read_text())


def numbers(directory):
    """What a study measured, to the last bit."""
    study = read_study(directory)
    poses = {}
    for entry in study["sweeps"]:
        if entry["status"] == "done":
            reconstruction = read_reconstruction(directory / entry["folder"] / "reconstruction.h5")
            poses[entry["name"]] = {m: p.as_matrix().tobytes() for m, p in reconstruction.poses.items()}
            poses[entry["name"]]["pairs"] = reconstruction.pairs.covariance.tobytes()
    return study["rows"], study["drift"], poses


def test_every_mode_and_the_tracker_alone_and_the_broken_sweep_as_a_row(study):
    contents = read_study(study.directory)
    assert contents["modes"] == MODES
    assert [entry["status"] for entry in contents["sweeps"]] == ["done", "failed", "done"]
    assert "broken.h5" in contents["sweeps"][1]["reason"]
    assert contents["sweeps"][1]["reason"] in (study.directory / "table.txt").read_text()
    expected = {(s, m) for s in ("s5", "s6") for m in MODES}
    assert {(row["sweep"], row["mode"]) for row in contents["drift"]} == expected
    assert {(row["sweep"], row["mode"]) for row in contents["rows"]} == expected
    rows = list(csv.DictReader(io.StringIO((study.directory / "table.csv").read_text())))
    assert [row["reason"] != "" for row in rows if row["sweep"] == "broken"] == [True]
    # Two sweeps are no statistics.
    assert (contents["intervals"], contents["paired"]) == ([], [])
    assert [path for path in study.directory.rglob("*") if ".part-" in path.name] == []


def test_one_number_for_a_length_in_every_output(study):
    folder = study.directory / read_study(study.directory)["sweeps"][0]["folder"]
    (row,) = [
        row for row in read_study(study.directory)["rows"] if (row["sweep"], row["mode"]) == ("s5", "pose")
    ]
    (summary,) = json.loads((folder / "summary.json").read_text())["sweeps"]
    assert row["estimate_mm"] in [r["estimate_mm"] for r in summary["rows"]]
    for table in (folder / "table.txt", study.directory / "table.txt"):
        (line,) = [x for x in table.read_text().splitlines() if re.match("s5 +f +pose ", x)]
        assert line.split()[3] == f"{row['estimate_mm']:.2f}"
        assert line.split()[4] == f"{1.96 * row['sigma_mm']:.2f}"


@pytest.mark.slow
def test_a_second_start_does_nothing_again_but_what_is_missing(study, sweeps, tmp_path):
    shutil.copytree(study.directory, tmp_path / "again")
    before = numbers(study.directory)
    again = compare_sweeps(sweeps, tmp_path / "again")
    assert [outcome.is_old for outcome in again.outcomes] == [True, False, True]
    assert numbers(again.directory) == before
    shutil.rmtree(tmp_path / "again" / read_study(study.directory)["sweeps"][0]["folder"])
    again = compare_sweeps(sweeps, tmp_path / "again")
    assert [outcome.is_old for outcome in again.outcomes] == [False, False, True]
    assert numbers(again.directory) == before
    settings = Config(sensors={"consistent_subset": False})
    third = compare_sweeps(sweeps[:1], tmp_path / "again", config=settings)
    assert not third.outcomes[0].is_old
    assert read_study(tmp_path / "again")["modes"] == ["image", "orientation", "pose", "fused", "tracker"]


def test_a_mode_that_a_sweep_has_no_sensor_for_is_its_reason(sweeps, tmp_path):
    bare = tmp_path / "bare.h5"
    write_sweep(bare, replace(load_sweep(sweeps[0]), orientation=None, tracker=None))
    shutil.copy(sweeps[0].parent / "curves.h5", tmp_path)
    study = compare_sweeps([bare], tmp_path / "asked", ["pose"])
    assert re.search("bare.*tracker", study.outcomes[0].reason)
    assert read_study(compare_sweeps([bare], tmp_path / "all").directory)["modes"] == ["image"]
