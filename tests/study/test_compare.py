"""A study of sweeps: every mode, broken sweeps as rows, and only what is missing at a second start."""

import csv
import io
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from speckle3d.config import Config
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.io.challenge import Landmarks
from speckle3d.io.load import load_sweep
from speckle3d.io.reconstructions import read_reconstruction
from speckle3d.io.sweep_writer import write_sweep
from speckle3d.scoring.displacements import point_errors
from speckle3d.study.compare import compare_sweeps, named
from speckle3d.study.reslices.cut_geometry import read_plane
from speckle3d.study.schedulers import Scheduler

MODES = ["image", "consistent-subset", "orientation", "pose", "fused", "tracker"]


@pytest.fixture(scope="module")
def sweeps(small_sweeps):
    """Two small sweeps, and one whose file is broken."""
    (small_sweeps / "broken.h5").write_bytes(b"nothing")
    return [small_sweeps / name for name in ("s5.h5", "broken.h5", "s6.h5")]


@pytest.fixture(scope="module")
def study(sweeps, tmp_path_factory):
    return compare_sweeps(sweeps, tmp_path_factory.mktemp("study"))


def stored(directory):
    return json.loads((directory / "study.json").read_text())


def numbers(directory):
    """What a study measured, to the last bit."""
    study = stored(directory)
    poses = {}
    for entry in study["sweeps"]:
        if entry["status"] == "done":
            made = read_reconstruction(directory / entry["folder"] / "reconstruction.h5")
            poses[entry["name"]] = {m: p.as_matrix().tobytes() for m, p in made.poses.items()}
            poses[entry["name"]]["pairs"] = made.pairs.covariance.tobytes()
    return study["rows"], study["drift"], poses


def test_every_mode_and_the_tracker_alone_and_the_broken_sweep_as_a_row(study):
    contents = stored(study.directory)
    assert contents["modes"] == MODES
    assert [entry["status"] for entry in contents["sweeps"]] == ["done", "failed", "done"]
    assert "broken.h5" in contents["sweeps"][1]["reason"]
    assert contents["sweeps"][1]["reason"] in (study.directory / "table.txt").read_text()
    wanted = {(s, m) for s in ("s5", "s6") for m in MODES}
    assert {(row["sweep"], row["mode"]) for row in contents["drift"]} == wanted
    assert {(row["sweep"], row["mode"]) for row in contents["rows"]} == wanted
    rows = list(csv.DictReader(io.StringIO((study.directory / "table.csv").read_text())))
    assert [row["reason"] != "" for row in rows if row["sweep"] == "broken"] == [True]
    # Two sweeps are no statistics.
    assert (contents["intervals"], contents["paired"]) == ([], [])
    assert [path for path in study.directory.rglob("*") if ".part-" in path.name] == []


def test_one_number_for_a_length_in_every_output(study):
    folder = study.directory / stored(study.directory)["sweeps"][0]["folder"]
    (row,) = [row for row in stored(study.directory)["rows"] if (row["sweep"], row["mode"]) == ("s5", "pose")]
    (summary,) = json.loads((folder / "summary.json").read_text())["sweeps"]
    assert row["estimate_mm"] in [each["estimate_mm"] for each in summary["rows"]]
    for table in (folder / "table.txt", study.directory / "table.txt"):
        (line,) = [x for x in table.read_text().splitlines() if re.match("s5 +f +pose ", x)]
        assert line.split()[3] == f"{row['estimate_mm']:.2f}"
        assert line.split()[4] == f"{1.96 * row['sigma_mm']:.2f}"


def test_the_enlarged_part_lies_where_it_does_in_the_whole_cut(study):
    folder = study.directory / stored(study.directory)["sweeps"][0]["folder"]
    whole, part = (read_plane(folder / name, "pose").cut for name in ("reslice.png", "enlarged.png"))
    x, y = part.first_mm
    pixels_mm = whole.world_from_mm([x, x + 1.0], [y, y + 2.0])
    np.testing.assert_allclose(part.world_from_mm([x, x + 1.0], [y, y + 2.0]), pixels_mm, atol=1e-9)


def test_a_second_start_does_nothing_again_but_what_is_missing(study, sweeps, tmp_path):
    shutil.copytree(study.directory, tmp_path / "again")
    before = numbers(study.directory)
    again = compare_sweeps(sweeps, tmp_path / "again")
    assert [each.skipped for each in again.outcomes] == [True, False, True]
    assert numbers(again.directory) == before
    shutil.rmtree(tmp_path / "again" / stored(study.directory)["sweeps"][0]["folder"])
    again = compare_sweeps(sweeps, tmp_path / "again")
    assert [each.skipped for each in again.outcomes] == [False, False, True]
    assert numbers(again.directory) == before
    other = Config().with_choices(consistent_subset=False, drift_curves=None)
    changed = compare_sweeps(sweeps[:1], tmp_path / "again", config=other)
    assert not changed.outcomes[0].skipped
    assert stored(tmp_path / "again")["modes"] == ["image", "orientation", "pose", "fused", "tracker"]


@pytest.mark.slow
def test_worker_processes_give_the_same_bits(study, sweeps, tmp_path):
    again = compare_sweeps(sweeps, tmp_path / "out", scheduler=Scheduler(2))
    assert [each.status for each in again.outcomes] == ["done", "failed", "done"]
    assert numbers(again.directory) == numbers(study.directory)


def test_a_mode_that_a_sweep_has_no_sensor_for_is_its_reason(sweeps, tmp_path):
    bare = tmp_path / "bare.h5"
    write_sweep(bare, replace(load_sweep(sweeps[0]), orientation=None, tracker=None))
    shutil.copy(sweeps[0].parent / "curves.h5", tmp_path)
    asked = compare_sweeps([bare], tmp_path / "asked", ["pose"])
    assert re.search("bare.*tracker", asked.outcomes[0].reason)
    assert stored(compare_sweeps([bare], tmp_path / "all").directory)["modes"] == ["image"]


def test_a_bug_in_one_sweep_is_its_reason_and_leaves_nothing(sweeps, tmp_path, monkeypatch):
    def broken(*_, **__):
        raise ZeroDivisionError("in the middle")

    monkeypatch.setattr("speckle3d.study.job.draw_strip", broken)
    outcome = compare_sweeps(sweeps[:1], tmp_path / "out").outcomes[0]
    assert outcome.reason == "ZeroDivisionError: in the middle"
    assert not (tmp_path / "out" / "sweeps").exists()


def test_files_of_one_name_are_told_apart_and_one_given_twice_is_one(tmp_path):
    a, b, c = (tmp_path / name for name in ("a/s.h5", "b/s.h5", "a/t.h5"))
    assert named([a, b, a, c]) == [("a-s", a), ("b-s", b), ("t", c)]
    assert dict(named([b, a])) == {"a-s": a, "b-s": b}
    twins = [tmp_path / name for name in ("x/a/s.h5", "y/a/s.h5")]
    names = [name for name, _ in named(twins)]
    assert len(set(names)) == 2
    assert named([tmp_path / "s\x1b[31m.h5"])[0][0] == "s%x1b[31m"


def test_copies_of_a_recording_count_once(study, sweeps, tmp_path):
    shutil.copytree(study.directory, tmp_path / "again")
    shutil.copy(sweeps[0], tmp_path / "a.h5")
    curves = sweeps[0].parent / "curves.h5"
    again = compare_sweeps([*sweeps, tmp_path / "a.h5"], tmp_path / "again", curves=curves)
    assert [each.status for each in again.outcomes] == ["done", "failed", "done", "failed"]
    assert "s5" in again.outcomes[3].reason
    # Three files, of which two are one sweep: no statistics.
    assert stored(again.directory)["intervals"] == []


def test_broken_sweeps_alone_are_refused_and_nothing_is_written(sweeps, tmp_path):
    with pytest.raises(InsufficientDataError):
        compare_sweeps([sweeps[1]], tmp_path / "study")
    with pytest.raises(InvalidInputError):
        compare_sweeps([], tmp_path / "study")
    assert not (tmp_path / "study").exists()


def test_landmarks_that_come_with_a_sweep_are_scored(sweeps, tmp_path, monkeypatch):
    marks = Landmarks(np.array([3, 20]), np.array([[1.0, 2.0, 0.0], [4.0, 8.0, 0.0]]))
    monkeypatch.setattr("speckle3d.study.job.load_landmarks", lambda path: marks)
    study = compare_sweeps(sweeps[:1], tmp_path, ["pose"])
    (entry,) = stored(tmp_path)["sweeps"]
    poses = read_reconstruction(tmp_path / entry["folder"] / "reconstruction.h5").poses["pose"]
    (row,) = [row for row in study.drift if row["mode"] == "pose"]
    expected = point_errors(poses, load_sweep(sweeps[0]).truth, None, marks)
    assert (row["GLE_mm"], row["LLE_mm"]) == pytest.approx((expected["GLE_mm"], expected["LLE_mm"]))
