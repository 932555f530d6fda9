"""Files of one result: never mixed, whenever the process is killed, and one run at a time."""

import subprocess
import sys

import pytest

from speckle3d.core.errors import FileError
from speckle3d.io import fileset
from speckle3d.io.fileset import FileSet

FILES = FileSet("main.h5", ("a.txt", "b.txt"), ("made/page.html",))


def write(folder, content, error=None):
    with FILES.replaced(folder) as part:
        for name in FILES.names:
            (part / name).write_text(content)
        if error is not None:
            raise error


def contents(folder):
    return {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}


WHOLE = {content: dict.fromkeys(FILES.names, content) for content in ("old", "new")}


def test_a_set_takes_the_place_of_the_old_one_and_other_files_stay(tmp_path):
    write(tmp_path, "old")
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "page.html").write_text("of the old ones")
    before = tmp_path.stat().st_ino
    with FILES.replaced(tmp_path) as part:
        for name in FILES.names:
            (part / name).write_text("new")
        assert contents(tmp_path).items() >= WHOLE["old"].items()
    assert contents(tmp_path) == WHOLE["new"] | {"mine.txt": "mine"}
    assert tmp_path.stat().st_ino == before


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), ValueError("no"), OSError(28, "No space left on device")]
)
def test_a_failure_leaves_everything_as_it_was(tmp_path, error):
    kind = FileError if isinstance(error, OSError) else type(error)
    with pytest.raises(kind):
        write(tmp_path / "new", "new", error)
    assert list(tmp_path.iterdir()) == []
    write(tmp_path, "old")
    with pytest.raises(kind):
        write(tmp_path, "new", error)
    assert contents(tmp_path) == WHOLE["old"]


HOLDER = """
import sys, time
from pathlib import Path
from speckle3d.io import fileset
from speckle3d.io.fileset import FileSet
with FileSet("main.h5", ("a.txt", "b.txt")).replaced(Path(sys.argv[1])) as part:
    (part / "a.txt").write_text("half")
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_run_is_refused_until_the_first_is_gone_however_it_went(tmp_path):
    folder = tmp_path / "out"
    write(folder, "old")
    command = [sys.executable, "-c", HOLDER, str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(FileError, match="no other run"):
            write(folder, "new")
        holder.kill()
    assert contents(folder).items() >= WHOLE["old"].items()
    write(folder, "new")
    assert contents(tmp_path) == {f"out/{name}": "new" for name in FILES.names}


def test_broken_off_between_two_files_nothing_is_of_both_results(tmp_path, monkeypatch):
    write(tmp_path, "old")
    monkeypatch.setattr(fileset.shutil, "move", lambda *_: (_ for _ in ()).throw(OSError("broken off")))
    with pytest.raises(FileError):
        write(tmp_path, "new")
    assert contents(tmp_path) == {"main.h5": "old"}
