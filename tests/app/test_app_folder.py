"""Where the app may write."""

import os

import pytest

from speckle3d.app.phantom.viewer import new_path
from speckle3d.core.errors import InvalidInputError


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "sweep.h5").write_bytes(b"sweep")
    return tmp_path


def test_a_name_must_be_new_and_in_the_folder(folder, tmp_path):
    os.symlink(tmp_path.parent / "elsewhere.csv", tmp_path / "link.h5")
    for wrong in ("", "../a.h5", "/x/a.h5", ".hidden", "a\0.h5", "sweep.h5", "sweep", "link"):
        with pytest.raises(InvalidInputError):
            new_path(folder, wrong, ".h5")
