"""Commands that are told to end, killed, or run twice at once."""

import os
import shutil
import signal
import subprocess
import threading
import time

import pytest
from commands import SMALL, command

from speckle3d import cli
from speckle3d.io.reconstructions import read_reconstruction

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals as POSIX has them")

RESULTS = {
    "reconstruction.h5",
    "summary.json",
    "table.txt",
    "table.csv",
    "drift.png",
    "reslice.png",
    "enlarged.png",
}
STOPS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


def started(folder, *arguments):
    """The command as a process that has begun to write into a folder, or beside it."""
    process = subprocess.Popen(command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not any(".part-" in path.name and path.is_file() for path in folder.rglob("*")):
        assert process.poll() is None, "ended before it could be stopped"
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return process


def reconstruct(bench, out):
    return "reconstruct", bench / "sweep.h5", "-o", out


@pytest.mark.parametrize("number", STOPS)
def test_a_signal_that_asks_for_the_end_is_one_line_and_a_code(run, monkeypatch, number):
    before = signal.getsignal(number)

    def told(**_):
        os.kill(os.getpid(), number)
        time.sleep(10)

    monkeypatch.setattr(cli, "app", told)
    assert run() == (128 + number, "", "speckle3d: stopped\n")
    assert signal.getsignal(number) is before


def test_a_second_signal_does_not_disturb_the_cleaning_and_a_later_one_is_heard(run, monkeypatch):
    cleaned = []

    def told(**_):
        try:
            os.kill(os.getpid(), signal.SIGHUP)
        finally:
            for _ in range(3):
                os.kill(os.getpid(), signal.SIGTERM)
                cleaned.append(True)

    monkeypatch.setattr(cli, "app", told)
    assert run()[0] == 128 + signal.SIGHUP
    assert len(cleaned) == 3
    monkeypatch.setattr(cli, "_CLEANING_S", 0.0)
    assert run()[0] == 128 + signal.SIGHUP
    assert len(cleaned) == 3


@pytest.mark.parametrize("pause_s", [0.0, 0.3])
def test_a_signal_that_python_drops_is_sent_again_however_slowly_threads_start(run, monkeypatch, pause_s):
    class Slow(threading.Thread):
        def start(self):
            super().start()
            deadline = time.monotonic() + pause_s
            while time.monotonic() < deadline:
                time.sleep(0.01)

    class Finalised:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGTERM)

    def told(**_):
        Finalised()
        time.sleep(10)

    monkeypatch.setattr(cli, "app", told)
    monkeypatch.setattr(threading, "Thread", Slow)
    assert run() == (143, "", "speckle3d: stopped\n")


def test_what_a_process_was_started_to_ignore_stays_ignored(run, monkeypatch):
    def told(**_):
        os.kill(os.getpid(), signal.SIGHUP)

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        monkeypatch.setattr(cli, "app", told)
        assert run() == (0, "", "")
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.slow
def test_told_to_end_it_leaves_nothing_and_the_next_run_works(bench, tmp_path):
    out = tmp_path / "above" / "o"
    first = started(tmp_path, *reconstruct(bench, out))
    first.send_signal(signal.SIGTERM)
    stdout, err = first.communicate(timeout=60)
    assert (first.returncode, stdout) == (143, ""), err
    assert err.splitlines()[-1] == "speckle3d: stopped"
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []
    again = subprocess.run(command(*reconstruct(bench, out)), capture_output=True, text=True, timeout=120)
    assert again.returncode == 0, again.stderr
    assert {path.name for path in out.iterdir()} == RESULTS


def test_two_runs_into_one_folder_and_one_that_is_killed(bench, reconstructed, run, tmp_path):
    shutil.copytree(reconstructed, tmp_path / "o")
    (tmp_path / "o" / "mine.txt").write_text("mine")
    before = {path.name: path.read_bytes() for path in (tmp_path / "o").iterdir()}
    first = started(tmp_path, *reconstruct(bench, tmp_path / "o"))
    first.send_signal(signal.SIGSTOP)
    code, out, err = run(*reconstruct(bench, tmp_path / "o"))
    assert (code, out) == (2, "")
    assert err.splitlines()[-1].startswith(f"speckle3d: {tmp_path / 'o'}: expected a place that no other run")
    first.kill()
    first.communicate(timeout=60)
    # Its three modes and its tables are those of the run before.
    held = {path.name: path for path in (tmp_path / "o").iterdir()}
    assert {name: held[name].read_bytes() for name in before} == before
    code, _, err = run(*reconstruct(bench, tmp_path / "o"))
    assert code == 0, err
    assert {path.name for path in (tmp_path / "o").iterdir()} == RESULTS | {"mine.txt"}
    assert set(read_reconstruction(tmp_path / "o" / "reconstruction.h5").poses) == {"image"}


def test_results_do_not_take_the_place_of_other_files(refused, bench, reconstructed, tmp_path):
    (tmp_path / "table.txt").write_text("mine")
    assert "table.txt" in refused(*reconstruct(bench, tmp_path))
    assert "table.txt" in refused("compare", bench / "sweep.h5", "-o", tmp_path)
    shutil.copytree(reconstructed, tmp_path / "o")
    assert "table.txt" in refused("compare", bench / "sweep.h5", "-o", tmp_path / "o")
    (tmp_path / "o" / "study.json").write_text('{"format": "speckle3d.study"}')
    assert "origin" in refused(*reconstruct(bench, tmp_path / "o"))
    shutil.copy(bench / "sweep.h5", tmp_path / "reconstruction.h5")
    (tmp_path / "table.txt").unlink()
    assert "reconstruction.h5" in refused(*reconstruct(bench, tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "number"), [("phantom", signal.SIGINT), ("crossed", signal.SIGHUP)])
def test_a_simulation_told_to_end_leaves_nothing(tmp_path, preset, number):
    process = started(tmp_path, "simulate", tmp_path / "s.h5", *SMALL, "--preset", preset, "--frames", "200")
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 128 + number, err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--workers", "2")])
def test_a_study_told_to_end_before_its_first_sweep_is_done_leaves_no_folder(bench, tmp_path, options):
    process = started(tmp_path, "compare", bench / "sweep.h5", "-o", tmp_path / "above" / "o", *options)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 143, err
    assert err.splitlines()[-1] == "speckle3d: stopped"
    assert "Traceback" not in err
    # A worker may end its sweep first: then that is whole.
    left = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert not left or (options and {"reconstruction.h5", "summary.json", "table.txt"} <= left)
