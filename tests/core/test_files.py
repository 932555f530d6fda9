"""Temporary files, and what a disk that is full is called."""

import pytest

from speckle3d.core.files import whole_file


def fail_to_write(target):
    with whole_file(target) as part:
        part.write_text("half")
        raise ZeroDivisionError


def test_what_a_killed_process_left_is_removed_and_what_is_at_work_is_not(tmp_path):
    target, foreign = tmp_path / "a[1].h5", tmp_path / ".part-0123abcd-b.h5"
    (tmp_path / ".part-0123abcd-a[1].h5").touch()
    foreign.touch()
    with whole_file(target) as first:
        first.write_text("one")
        with whole_file(target) as second:
            second.write_text("two")
            assert sorted(tmp_path.iterdir()) == sorted([first, second, foreign])
            assert second.suffix == target.suffix
        assert target.read_text() == "two"
    assert sorted(tmp_path.iterdir()) == sorted([target, foreign])
    assert target.read_text() == "one"
    with pytest.raises(ZeroDivisionError):
        fail_to_write(target)
    assert sorted(tmp_path.iterdir()) == sorted([target, foreign])
