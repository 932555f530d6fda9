"""Surfaces as files: what readers of other makers see, and damaged files."""

import numpy as np
import pytest

from speckle3d.core.surface import Surface
from speckle3d.io.shapes import SUFFIXES, read_surface, write_surface

CORNERS = np.array([[10.0, -20, 30], [11, -20, 30], [10, -19, 30], [10, -20, 31]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


@pytest.fixture(params=SUFFIXES)
def path(request, tmp_path):
    path = tmp_path / f"t{request.param}"
    write_surface(path, Surface(CORNERS, FACES))
    return path


def test_a_surface_survives_its_file(path):
    back = read_surface(path)
    np.testing.assert_allclose(back.vertices_mm[back.triangles], CORNERS[FACES], atol=1e-5)
    assert back.volume_mm3 == pytest.approx(1 / 6)


def test_headers_say_the_axes_as_slicer_looks_for_them(path):
    """In the header of STL and VTK, in a comment of PLY; see `vtkMRMLModelStorageNode` of 3D Slicer."""
    start = path.read_bytes()
    if path.suffix == ".stl":
        assert b"SPACE=LPS" in start[:80]
        assert not start.startswith(b"solid")
        assert len(start) == 84 + 50 * len(FACES)
    elif path.suffix == ".ply":
        assert b"\ncomment SPACE=LPS\n" in start
    else:
        assert b"SPACE=LPS" in start.split(b"\n")[1]
