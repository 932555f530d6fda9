"""The other tutorials run as written, in order, each in an empty folder."""

import pytest
from pages import ROOT, run_page

TUTORIALS = ROOT / "docs" / "tutorials"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("reconstruct.md", ("volume.nrrd", "along.png", "scene/scene.mrml", "out/enlarged.png")),
        ("wires.md", ("again.h5", "out/reconstruction.h5")),
        ("handheld.md", ("mounting.h5", "curves.h5", "volume.nrrd")),
        ("without-phantom.md", ("tracker.h5", "tracker.png")),
        ("compare.md", ("study/report.html",)),
    ],
)
def test_a_tutorial_makes_what_it_says(name, made, tmp_path):
    folder = tmp_path / "empty"
    folder.mkdir()
    run_page(TUTORIALS / name, folder)
    assert all((folder / each).exists() for each in made)
