"""Temporary files, and what a disk that is full is called."""

import os

import pytest

from speckle3d.core.errors import FileError, NoSpaceError
from speckle3d.core.parts import cannot_write, clear_parts, marked, part_beside


def test_what_a_killed_process_left_is_removed_and_what_is_at_work_is_not(tmp_path):
    target = tmp_path / "a[1].h5"
    left, other = part_beside(target), part_beside(tmp_path / "b.h5")
    left.touch()
    other.touch()
    with marked(live := part_beside(target)):
        clear_parts(target)
        assert sorted(tmp_path.iterdir()) == sorted([live, other])
    clear_parts(target)
    assert list(tmp_path.iterdir()) == [other]


@pytest.mark.parametrize("code", ["ENOSPC", "EFBIG", "EDQUOT", "EACCES"])
def test_only_a_lack_of_room_is_one(code):
    number = getattr(__import__("errno"), code)
    error = cannot_write("a.h5", OSError(number, os.strerror(number)))
    assert isinstance(error, FileError)
    assert isinstance(error, NoSpaceError) == (code != "EACCES")
    assert str(error) == f"a.h5: cannot be written: {os.strerror(number)}"
