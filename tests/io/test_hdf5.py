import pytest

from speckle3d.io.hdf5 import atomic_path


def write_then(path, text, error=None):
    with atomic_path(path) as part:
        part.write_text(text)
        if error is not None:
            raise error


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("no")])
def test_nothing_remains_of_a_block_that_fails(tmp_path, error):
    (tmp_path / "a").write_text("old")
    with pytest.raises(type(error)):
        write_then(tmp_path / "a", "new", error)
    assert (tmp_path / "a").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_link_is_written_through(tmp_path):
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write_then(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_text() == "new"
