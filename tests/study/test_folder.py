import itertools
import subprocess
import sys
from pathlib import Path

import pytest

from speckle3d.core.errors import FileError
from speckle3d.study.folder import named, only_run


def names_of(folder, *files):
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).touch()
    return {str(path.relative_to(folder)): name for name, path in named([folder / each for each in files])}


def test_sweeps_of_one_name_have_the_shortest_folders_that_tell_them_apart_in_any_order(tmp_path):
    files = ("x/1/s.h5", "y/1/s.h5", "x/2/s.h5", "x/2/t.h5")
    expected = {"x/1/s.h5": "x-1-s", "y/1/s.h5": "y-1-s", "x/2/s.h5": "2-s", "x/2/t.h5": "t"}
    for order in itertools.permutations(files):
        assert names_of(tmp_path, *order) == expected


def test_names_that_meet_on_the_way_are_told_apart_too(tmp_path):
    found = names_of(tmp_path, "a/b.h5", "c/b.h5", "a-b.h5", "d/e.h5", "d/e.mha")
    assert len(set(found.values())) == 5
    assert (found["c/b.h5"], found["d/e.h5"], found["d/e.mha"]) == ("c-b", "e-h5", "e-mha")
    joined = names_of(tmp_path, "k/l-m/n.h5", "k-l/m/n.h5", "k/l/m-n.h5")
    assert len(set(joined.values())) == 3


def test_one_file_given_twice_is_one_and_a_link_has_its_own_name(tmp_path):
    (tmp_path / "s.h5").touch()
    (tmp_path / "again.h5").symlink_to(tmp_path / "s.h5")
    (tmp_path / "dangling.h5").symlink_to(tmp_path / "gone.h5")
    paths = [tmp_path / name for name in ("s.h5", "again.h5", "dangling.h5")]
    assert named([*paths, paths[0]]) == [("s", paths[0]), ("dangling", paths[2])]
    assert named([Path("s.h5")])[0][0] == "s"


HOLDER = """
import sys, time
from pathlib import Path
from speckle3d.study.folder import only_run
with only_run(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_folder_is_held_until_its_process_is_gone(tmp_path):
    command = [sys.executable, "-c", HOLDER, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(FileError, match=f"process {holder.pid}"), only_run(tmp_path):
            pass
        holder.kill()
    with only_run(tmp_path):
        pass


def test_a_run_may_hold_its_folder_already(tmp_path):
    with only_run(tmp_path), only_run(tmp_path):
        pass
    with only_run(tmp_path):
        pass


def test_a_folder_made_for_nothing_is_removed_and_one_that_was_there_stays(tmp_path):
    for folder in (tmp_path / "above" / "new", tmp_path / "there"):
        (tmp_path / "there").mkdir(exist_ok=True)
        with pytest.raises(KeyboardInterrupt), only_run(folder):
            raise KeyboardInterrupt
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
    with only_run(tmp_path / "above"):
        (tmp_path / "above" / "study.json").touch()
    assert (tmp_path / "above" / "study.json").exists()
