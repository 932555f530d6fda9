import csv
import fcntl
import json
import os
import re
import shutil
import signal
import threading
import time
from dataclasses import replace

import challenge_examples
import numpy as np
import pytest

from speckle3d.config import Config
from speckle3d.core.errors import FileError, InsufficientDataError, InvalidInputError
from speckle3d.io.challenge import Landmarks
from speckle3d.io.load import load_sweep
from speckle3d.io.reconstructions import read_reconstruction
from speckle3d.io.sweep_writer import write_sweep
from speckle3d.scoring.displacements import landmark_errors
from speckle3d.study.compare import StudyProgress, compare_sweeps
from speckle3d.study.folder import LOCK
from speckle3d.study.results import SweepOutcome
from speckle3d.study.schedulers import OnCluster, local_cluster
from speckle3d.study.sweepjob import plan_sweep, run_sweep

# Dask's processes leave sockets to the garbage collector when one is killed.
pytestmark = pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)

MODES = ["image", "consistent-subset", "orientation", "pose", "fused"]


@pytest.fixture(scope="module")
def sweeps(small_sweeps):
    """Two small sweeps, and one whose file is broken."""
    (small_sweeps / "broken.h5").write_bytes(b"nothing")
    return [small_sweeps / name for name in ("s5.h5", "broken.h5", "s6.h5")]


@pytest.fixture(scope="module")
def study(sweeps, tmp_path_factory):
    return compare_sweeps(sweeps, tmp_path_factory.mktemp("study"))


def held(directory):
    return json.loads((directory / "study.json").read_text())


def numbers(directory):
    """What a study measured, to the last bit."""
    study = held(directory)
    poses = {}
    for entry in study["sweeps"]:
        if entry["status"] == "done":
            found = read_reconstruction(directory / entry["folder"] / "reconstruction.h5")
            poses[entry["name"]] = {m: p.as_matrix().tobytes() for m, p in found.poses.items()}
            poses[entry["name"]]["pairs"] = found.pairs.covariance.tobytes()
    return study["rows"], study["drift"], poses


def test_every_mode_that_has_sensors_and_the_broken_sweep_as_a_row(study):
    found = held(study.directory)
    assert found["modes"] == MODES
    assert [entry["status"] for entry in found["sweeps"]] == ["done", "failed", "done"]
    assert "broken.h5" in found["sweeps"][1]["reason"]
    assert {(row["sweep"], row["mode"]) for row in found["drift"]} == {
        (s, m) for s in ("s5", "s6") for m in MODES
    }
    assert found["sweeps"][1]["reason"] in (study.directory / "table.txt").read_text()
    rows = list(csv.DictReader((study.directory / "table.csv").open()))
    assert [row["reason"] != "" for row in rows if row["sweep"] == "broken"] == [True]
    assert {row["mode"] for row in rows if row["sweep"] == "s6"} == set(MODES)
    assert [path for path in study.directory.rglob("*") if ".part-" in path.name] == []


def test_means_over_sweeps_are_in_the_study_and_in_the_table(study):
    found = held(study.directory)
    (mean,) = [r for r in found["intervals"] if (r["quantity"], r["mode"]) == ("FDR_percent", "pose")]
    assert mean["sweeps"] == 2
    assert mean["mean"] == pytest.approx(
        np.mean([r["FDR_percent"] for r in found["drift"] if r["mode"] == "pose"])
    )
    pairs = [(r["mode"], r["against"]) for r in found["paired"] if r["quantity"] == "length_error_percent"]
    assert len(pairs) == len(set(pairs)) == 10
    # Two sweeps cannot tell modes apart.
    assert {r["better"] for r in found["paired"]} == {None}
    assert "2 sweeps" in (study.directory / "table.txt").read_text()


def test_a_second_start_does_nothing_again_but_what_changed(study, sweeps, tmp_path):
    shutil.copytree(study.directory, tmp_path / "again")
    before = numbers(study.directory)
    again = compare_sweeps(sweeps, tmp_path / "again")
    assert [each.skipped for each in again.outcomes] == [True, False, True]
    assert numbers(again.directory) == before
    # A folder without its last file is done again.
    (tmp_path / "again" / held(study.directory)["sweeps"][0]["folder"] / "job.json").unlink()
    again = compare_sweeps(sweeps, tmp_path / "again")
    assert [each.skipped for each in again.outcomes] == [False, False, True]
    assert numbers(again.directory) == before
    other = Config().with_choices(consistent_subset=False, drift_curves=None)
    changed = compare_sweeps(sweeps[:1], tmp_path / "again", config=other)
    assert not changed.outcomes[0].skipped
    assert held(tmp_path / "again")["modes"] == ["image", "orientation", "pose", "fused"]


@pytest.mark.slow
def test_workers_give_the_same_bits_though_one_is_killed(study, sweeps, tmp_path):
    killed = []
    with local_cluster(2) as client:
        workers = [each["pid"] for each in client.run(lambda: {"pid": os.getpid()}).values()]

        def kill():
            # As soon as a sweep is being worked at.
            while not list((tmp_path / "out" / "sweeps").glob(".part-*")):
                time.sleep(0.005)
            os.kill(workers[0], signal.SIGKILL)
            killed.append(workers[0])

        thread = threading.Thread(target=kill, daemon=True)
        thread.start()
        found = compare_sweeps(sweeps, tmp_path / "out", scheduler=OnCluster(client))
        thread.join(timeout=20)
    assert len(killed) == 1
    assert [each.status for each in found.outcomes] == ["done", "failed", "done"]
    assert numbers(found.directory) == numbers(study.directory)
    assert list((tmp_path / "out" / "sweeps").glob(".part-*")) == []


def test_a_mode_that_a_sweep_has_no_sensor_for_is_its_reason(sweeps, tmp_path):
    bare = tmp_path / "bare.h5"
    sweep = load_sweep(sweeps[0])
    write_sweep(bare, replace(sweep, orientation=None, tracker=None))
    shutil.copy(sweeps[0].parent / "curves.h5", tmp_path)
    asked = compare_sweeps([bare], tmp_path / "asked", ["pose"])
    assert re.search("bare.*tracker", asked.outcomes[0].reason)
    assert held(compare_sweeps([bare], tmp_path / "all").directory)["modes"] == ["image"]


def test_a_file_that_changed_under_the_study_is_its_reason(sweeps, tmp_path):
    for name in ("s5.h5", "curves.h5"):
        shutil.copy(sweeps[0].parent / name, tmp_path)
    job = plan_sweep("s5", tmp_path / "s5.h5", tmp_path, None, Config().to_toml(), None, None, ())
    shutil.copy(sweeps[2], tmp_path / "s5.h5")
    assert run_sweep(job).reason.startswith(str(tmp_path / "s5.h5"))


def test_a_bug_in_one_sweep_is_its_reason_without_temporary_names_and_leaves_nothing(
    sweeps, tmp_path, monkeypatch
):
    def full(request, directory, *others):
        raise ZeroDivisionError(f"in the middle of {directory / '.part-0123abcd-reconstruction.h5'}")

    monkeypatch.setattr("speckle3d.study.sweepjob.write_results", full)
    # Words are set one space apart; a path with two must not hide its temporary name.
    found = compare_sweeps(sweeps[:1], tmp_path / "two  spaces")
    assert re.match("ZeroDivisionError: in the middle.*reconstruction.h5", found.outcomes[0].reason)
    assert ".part-" not in (tmp_path / "two  spaces" / "study.json").read_text()
    assert list((tmp_path / "two  spaces" / "sweeps").iterdir()) == []


def test_sweeps_of_one_name_are_told_apart_and_one_given_twice_is_one(sweeps, tmp_path):
    (tmp_path / "other").mkdir()
    twin = tmp_path / "other" / "broken.h5"
    twin.write_bytes(b"nothing")
    found = compare_sweeps([sweeps[1], twin, sweeps[1], sweeps[0]], tmp_path, ["pose"])
    first = f"{sweeps[1].parent.name}-broken"
    assert [each.name for each in found.outcomes] == [first, "other-broken", "s5"]


def test_a_sweep_that_is_not_there_is_named_as_it_was_given(sweeps, tmp_path):
    (tmp_path / "dangling.h5").symlink_to(tmp_path / "gone.h5")
    found = compare_sweeps([tmp_path / "missing.h5", tmp_path / "dangling.h5", sweeps[0]], tmp_path, ["pose"])
    reasons = {each.name: each.reason for each in found.outcomes if each.status == "failed"}
    assert reasons["missing"].startswith(str(tmp_path / "missing.h5"))
    assert reasons["dangling"].startswith(str(tmp_path / "gone.h5"))


def test_copies_of_a_recording_count_once(study, sweeps, tmp_path):
    shutil.copytree(study.directory, tmp_path / "again")
    for name in ("a.h5", "b.h5"):
        shutil.copy(sweeps[0], tmp_path / name)
    found = compare_sweeps(
        [*sweeps, tmp_path / "a.h5", tmp_path / "b.h5"],
        tmp_path / "again",
        curves=sweeps[0].parent / "curves.h5",
    )
    assert found.copies == {"a": "s5", "b": "s5"}
    assert "a is a copy of s5" in found.table
    once, thrice = held(study.directory), held(found.directory)
    for key in ("intervals", "shared", "paired"):
        assert thrice[key] == once[key]
    assert len(thrice["rows"]) == 2 * len(once["rows"])
    rows = list(csv.DictReader((found.directory / "table.csv").open()))
    assert {(row["sweep"], row["copy_of"]) for row in rows if row["copy_of"]} == {("a", "s5"), ("b", "s5")}
    assert {row["path"] for row in rows if row["sweep"] == "a"} == {str(tmp_path / "a.h5")}


def test_a_second_run_in_one_folder_touches_nothing_of_the_first(sweeps, tmp_path):
    begun = tmp_path / "sweeps" / ".part-0123abcd-s5-00000000"
    begun.mkdir(parents=True)
    # A lock held through another open file is another run's, whichever process holds it.
    with (tmp_path / LOCK).open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(FileError, match=tmp_path.name):
            compare_sweeps(sweeps[:1], tmp_path)
    assert begun.exists()
    assert not (tmp_path / "study.json").exists()
    assert compare_sweeps(sweeps[:1], tmp_path, ["pose"]).outcomes[0].status == "done"


def test_broken_sweeps_alone_are_refused_and_nothing_is_written(sweeps, tmp_path):
    with pytest.raises(InsufficientDataError, match="broken"):
        compare_sweeps([sweeps[1]], tmp_path / "study")
    with pytest.raises(InvalidInputError):
        compare_sweeps([], tmp_path / "study")
    assert not (tmp_path / "study").exists()


def test_landmarks_that_come_with_a_sweep_are_scored(sweeps, tmp_path, monkeypatch):
    marks = Landmarks(np.array([3, 20]), np.array([[1.0, 2.0, 0.0], [4.0, 8.0, 0.0]]))
    monkeypatch.setattr("speckle3d.study.sweepjob.load_landmarks", lambda path: marks)
    found = compare_sweeps(sweeps[:1], tmp_path, ["pose"])
    sweep = load_sweep(sweeps[0])
    (entry,) = held(tmp_path)["sweeps"]
    poses = read_reconstruction(tmp_path / entry["folder"] / "reconstruction.h5").poses["pose"]
    expected = landmark_errors(poses, sweep.truth, marks)
    (row,) = [row for row in found.drift if row["mode"] == "pose"]
    assert (row["GLE_mm"], row["LLE_mm"]) == pytest.approx((expected.global_mm, expected.local_mm))
    assert {row["quantity"] for row in held(tmp_path)["intervals"]} >= {"GLE_mm", "LLE_mm"}


def test_a_scan_is_another_when_a_file_beside_it_is(sweeps, tmp_path):
    path, *_ = challenge_examples.write_data_set(tmp_path)
    curves = sweeps[0].parent / "curves.h5"

    def key():
        return plan_sweep("scan", path, tmp_path, curves, Config().to_toml(), None, None, ()).key

    before = key()
    assert key() == before
    csv_path = tmp_path / "calib_matrix.csv"
    csv_path.write_text(csv_path.read_text().replace("33.0", "34.0"))
    assert key() != before


def test_progress_knows_the_time_left_from_the_first_finished_sweep_on(tmp_path):
    def done(frames, **more):
        return SweepOutcome("a", tmp_path, "done", frames=frames, **more)

    at = StudyProgress(sweeps=3, frames=300)
    at.add(done(100, skipped=True), 2)
    assert at.remaining_s is None
    at.add(done(100, seconds=20.0), 2)
    # One sweep of 100 frames is left, on one of the two workers, at 0.2 s a frame.
    assert at.remaining_s == pytest.approx(20.0)
    at.add(SweepOutcome("c", tmp_path, "failed", "torn", frames=100), 2)
    assert (at.remaining_s, at.failed, at.done) == (0.0, 1, 3)
    # Rates 0.1, 0.1 and 5 s a frame: one slow sweep does not change the median.
    slow = StudyProgress(sweeps=4, frames=360)
    for frames, seconds in ((100, 10.0), (50, 5.0), (10, 50.0)):
        slow.add(done(frames, seconds=seconds), 2)
    assert slow.remaining_s == pytest.approx(20.0)
