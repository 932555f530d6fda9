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
from speckle3d.io.family.reconstructions import read_reconstruction

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals as POSIX has them")

WAIT_S = 120.0
"""Longest wait for another process on a busy machine."""


def start(folder, *arguments):
    """The command as a process that has begun to write into a folder, or beside it."""
    process = subprocess.Popen(command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + WAIT_S
    while not any(".part-" in path.name and path.is_file() for path in folder.rglob("*")):
        assert process.poll() is None, "ended before it could be stopped"
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return process


@pytest.fixture
def run_as_command(run, monkeypatch):
    """Run a function as the command; returns exit code, stdout and stderr."""

    def call(function):
        monkeypatch.setattr(cli, "app", lambda **_: function())
        return run()

    return call


def wait_for_signal():
    """Bytecode in which a signal is heard."""
    deadline = time.monotonic() + 30.0
    while time.monotonic() < deadline:
        pass
    raise AssertionError("the signal was lost")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_that_asks_for_the_end_is_one_line_and_a_code(run_as_command, number):
    def work():
        signal.raise_signal(number)
        wait_for_signal()

    assert run_as_command(work) == (128 + number, "", "speckle3d: stopped\n")


def test_a_process_that_must_ignore_a_signal_does(run_as_command):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert run_as_command(lambda: signal.raise_signal(signal.SIGHUP)) == (0, "", "")
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.slow
def test_told_to_end_it_leaves_nothing(bench, tmp_path):
    process = start(tmp_path, "reconstruct", bench / "sweep.h5", "-o", tmp_path / "o")
    process.terminate()
    _, err = process.communicate(timeout=WAIT_S)
    assert (process.returncode, err.splitlines()[-1]) == (128 + signal.SIGTERM, "speckle3d: stopped"), err
    assert list(tmp_path.iterdir()) == []


def test_a_run_into_a_folder_in_use_and_after_a_kill(bench, results, run, tmp_path):
    out = tmp_path / "o"
    shutil.copytree(results, out)
    (out / "mine.txt").write_text("mine")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    first = start(tmp_path, "reconstruct", bench / "sweep.h5", "-o", out)
    try:
        first.send_signal(signal.SIGSTOP)
        code, _, err = run("reconstruct", bench / "sweep.h5", "-o", out)
    finally:
        first.kill()
        first.communicate(timeout=WAIT_S)
    assert code == 2
    assert err.splitlines()[-1].startswith(f"speckle3d: {out}: expected a place that no other run")
    # Its three modes and its tables are those of the run before.
    paths = {path.name: path for path in out.iterdir()}
    assert {name: paths[name].read_bytes() for name in before} == before
    code, _, err = run("reconstruct", bench / "sweep.h5", "-o", out)
    assert code == 0, err
    assert {path.name for path in out.iterdir()} == set(before)
    assert set(read_reconstruction(out / "reconstruction.h5").poses) == {"image"}


def test_a_signal_in_a_finalizer_is_heard():
    class Finalizer:
        def __del__(self):
            signal.raise_signal(signal.SIGTERM)

    def work():
        Finalizer()
        time.sleep(1.0)

    with stoppable() as heard, pytest.raises(ToldToStopError):
        work()
    assert heard == [signal.SIGTERM]
