import pytest

from speckle3d.io.hdf5 import atomic_path, reading


def test_an_error_of_our_own_is_no_damaged_file():
    with pytest.raises(TypeError), reading("a.h5"):
        len(1)


def test_a_link_is_written_through(tmp_path):
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with atomic_path(tmp_path / "link") as part:
        part.write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_text() == "new"
