"""Where the app may write."""

import os

import pytest

from speckle3d.app.folder import new_path
from speckle3d.core.errors import InvalidInputError


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "sweep.h5").write_bytes(b"sweep")
    return tmp_path


def test_a_name_must_be_new_and_in_the_folder(folder, tmp_path):
    os.symlink(tmp_path.parent / "elsewhere.csv", tmp_path / "link.csv")
    for wrong in ("", "../a.csv", "/x/a.csv", ".hidden", "a\0.csv", "sweep.h5", "link.csv"):
        with pytest.raises(InvalidInputError):
            new_path(folder, wrong)
