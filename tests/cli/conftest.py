"""Commands run in this process, and what a small sweep of 24 frames gives."""

import shutil
import sys

import h5py
import pytest
from commands import SMALL, run_command
from made_once import made_once

from speckle3d import cli


@pytest.fixture
def run(monkeypatch, capfd):
    """Run the command in this process; returns exit code, stdout and stderr."""

    def call(*arguments):
        capfd.readouterr()
        monkeypatch.setattr(sys, "argv", ["speckle3d", *map(str, arguments)])
        with pytest.raises(SystemExit) as leave:
            cli.main()
        out, err = capfd.readouterr()
        return leave.value.code, out, err

    return call


@pytest.fixture
def refuse(run, tmp_path):
    """Run the command, which must refuse its input in one line and leave no file behind; returns the line."""

    def call(*arguments, folder=tmp_path):
        before = sorted(folder.rglob("*"))
        code, out, err = run(*arguments)
        # The bar's line, if frames were already being read, is not part of the message.
        lines = [line for line in err.splitlines() if line.startswith("speckle3d: ")]
        assert code == 2, err
        assert len(lines) == 1, err
        assert "Traceback" not in err
        assert out == ""
        left = [path for path in sorted(folder.rglob("*")) if path not in before and path.is_file()]
        assert left == []
        return lines[0]

    return call


@pytest.fixture(scope="session")
def bench(tmp_path_factory):
    """A folder with a small sweep and the curves for it, made by the command."""
    steps = ("--preset", "stepped", "--steps", "15", "--step-mm", "0.06", "--blocks", "2")

    def make(folder):
        for arguments in (
            ("simulate", folder / "sweep.h5", *SMALL, "--length-mm", "3", "--frames", "24"),
            ("simulate", folder / "stepped.h5", *SMALL, *steps),
            ("calibrate", "curves", folder / "stepped.h5", "-o", folder / "curves.h5"),
        ):
            run_command(*arguments)

    return made_once(tmp_path_factory, "bench", make)


@pytest.fixture(scope="session")
def results(bench, tmp_path_factory):
    """The folder of the small sweep's results."""
    modes = ("--drift", "orientation", "--drift", "pose")

    def make(folder):
        rows = run_command("reconstruct", bench / "sweep.h5", "-o", folder, *modes).splitlines()[2:6]
        assert [line.split()[2] for line in rows] == ["image", "orientation", "pose", "tracker"]

    return made_once(tmp_path_factory, "bench-out", make)


@pytest.fixture
def edit_sweep(bench, tmp_path):
    """The small sweep with something changed in it."""

    def change(edit):
        path = tmp_path / "sweep.h5"
        shutil.copy(bench / "sweep.h5", path)
        shutil.copy(bench / "curves.h5", tmp_path)
        with h5py.File(path, "r+") as file:
            edit(file)
        return path

    return change
