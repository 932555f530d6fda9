"""Commands that are told to end, killed, or run twice: each waits for a condition, never for a time."""

import os
import shutil
import signal
import subprocess
import time

import pytest
from commands import command

from speckle3d import cli
from speckle3d.cli.signals import ToldToStopError, stoppable
from speckle3d.io.reconstructions import read_reconstruction

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals as POSIX has them")

WAIT_S = 120.0
"""Longest wait for another process on a busy machine."""


def started(folder, *arguments):
    """The command as a process that has begun to write into a folder, or beside it."""
    process = subprocess.Popen(command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + WAIT_S
    while not any(".part-" in path.name and path.is_file() for path in folder.rglob("*")):
        assert process.poll() is None, "ended before it could be stopped"
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return process


@pytest.fixture
def told(run, monkeypatch):
    """Run a function as the command; returns exit code, stdout and stderr."""

    def call(function):
        monkeypatch.setattr(cli, "app", lambda **_: function())
        return run()

    return call


def until_stopped():
    """Bytecode in which a signal is heard."""
    deadline = time.monotonic() + 30.0
    while time.monotonic() < deadline:
        pass
    raise AssertionError("the signal was lost")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_that_asks_for_the_end_is_one_line_and_a_code(told, number):
    def work():
        signal.raise_signal(number)
        until_stopped()

    assert told(work) == (128 + number, "", "speckle3d: stopped\n")


def test_what_a_process_was_started_to_ignore_stays_ignored(told):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert told(lambda: signal.raise_signal(signal.SIGHUP)) == (0, "", "")
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.slow
def test_told_to_end_it_leaves_nothing(bench, tmp_path):
    process = started(tmp_path, "reconstruct", bench / "sweep.h5", "-o", tmp_path / "o")
    process.terminate()
    _, err = process.communicate(timeout=WAIT_S)
    assert (process.returncode, err.splitlines()[-1]) == (128 + signal.SIGTERM, "speckle3d: stopped"), err
    assert list(tmp_path.iterdir()) == []


def test_two_runs_into_one_folder_and_one_that_is_killed(bench, reconstructed, run, tmp_path):
    out = tmp_path / "o"
    shutil.copytree(reconstructed, out)
    (out / "mine.txt").write_text("mine")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    first = started(tmp_path, "reconstruct", bench / "sweep.h5", "-o", out)
    try:
        first.send_signal(signal.SIGSTOP)
        code, _, err = run("reconstruct", bench / "sweep.h5", "-o", out)
    finally:
        first.kill()
        first.communicate(timeout=WAIT_S)
    assert code == 2
    assert err.splitlines()[-1].startswith(f"speckle3d: {out}: expected a place that no other run")
    # Its three modes and its tables are those of the run before.
    held = {path.name: path for path in out.iterdir()}
    assert {name: held[name].read_bytes() for name in before} == before
    code, _, err = run("reconstruct", bench / "sweep.h5", "-o", out)
    assert code == 0, err
    assert {path.name for path in out.iterdir()} == set(before)
    assert set(read_reconstruction(out / "reconstruction.h5").poses) == {"image"}


def test_a_signal_in_a_finalizer_is_not_lost():
    class Finalized:
        def __del__(self):
            signal.raise_signal(signal.SIGTERM)

    def interrupted():
        Finalized()
        time.sleep(5.0)

    with stoppable() as heard, pytest.raises(ToldToStopError):
        interrupted()
    assert heard == [signal.SIGTERM]
