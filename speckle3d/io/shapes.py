"""Files of shapes: surfaces (STL, PLY, VTK), lines (VTK), poses (transforms of ITK).

World axes lead left, posterior and superior, as headers say for 3D Slicer. A transform file of ITK (.tfm)
holds what takes points of the parent to those of the child, as for resampling [1]_; Slicer shows its inverse
as the node's "transform to parent". So what is written is `world_from_image`'s inverse, in mm. A node with
that transform has image coordinates of P below it.

References
----------
.. [1] 3D Slicer user guide, "Transforms", section "ITK transform files".
"""

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.extras import extra_module
from speckle3d.core.files import PathLike
from speckle3d.core.surface import Surface
from speckle3d.io.hdf5 import atomic_path, reading, require_suffix
from speckle3d.io.text import number_text

SUFFIXES = (".stl", ".ply", ".vtk")
SPACE = "SPACE=LPS"
"""What 3D Slicer looks for in the header of STL and VTK, and among the comments of PLY."""
_STL_HEADER_BYTES = 80


def write_surface(path: PathLike, surface: Surface) -> None:
    """Write a surface whole or not at all, binary; the suffix chooses the format.

    Coordinates are the world's, mm, as float32; STL has no vertices in common between triangles. VTK is the
    legacy format, version 4.2, which older readers know, too.

    Parameters
    ----------
    path : path
        Ends in .stl, .ply or .vtk.
    surface : Surface
        At least one triangle; mm.

    Raises
    ------
    InvalidInputError
        If the suffix is not one of `SUFFIXES`.
    FileError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_surface(f"{folder}/s.ply", Surface(corners, np.array([[0, 1, 2]])))
    ...     len(read_surface(f"{folder}/s.ply"))
    1
    """
    suffix = require_suffix(path, SUFFIXES)
    meshio = extra_module("meshio", "surface", "a surface's file")
    points, triangles = surface.vertices_mm.astype(np.float32), surface.triangles.astype(np.int32)
    mesh = meshio.Mesh(points, [("triangle", triangles)])
    with atomic_path(path) as part:
        if suffix == ".stl":
            mesh.cell_data["facet_normals"] = [surface.normals.astype(np.float32)]
        meshio.write(part, mesh, "vtk42" if suffix == ".vtk" else suffix[1:], binary=True)
        content, title = part.read_bytes(), f"speckle3d surface. {SPACE}".encode()
        if suffix == ".stl":
            content = title.ljust(_STL_HEADER_BYTES) + content[_STL_HEADER_BYTES:]
        else:  # the first line that tells of meshio; what is behind it is binary
            title = f"comment {SPACE}".encode() if suffix == ".ply" else title
            content = re.sub(rb"^.*meshio.*$", title, content, count=1, flags=re.MULTILINE)
        part.write_bytes(content)


def read_surface(path: PathLike) -> Surface:
    """Read a surface of triangles.

    Parameters
    ----------
    path : path
        STL, PLY or VTK.

    Returns
    -------
    Surface

    Raises
    ------
    FileError
        If the file is missing, truncated or not of the format that its suffix says.
    InvalidInputError
        If the suffix is not one of `SUFFIXES`, or the file holds no triangles.
    """
    suffix = require_suffix(path, SUFFIXES)
    meshio = extra_module("meshio", "surface", "a surface's file")
    # A damaged file shows in whatever meshio happens to stumble over.
    with reading(f"{path}: as {suffix[1:].upper()}", Exception, SystemExit):
        if suffix == ".ply" and b"end_header" not in Path(path).read_bytes():
            raise ValueError("its header has no end")  # which meshio would search for ever
        mesh = meshio.read(path)
    triangles = [block.data for block in mesh.cells if block.type == "triangle"]
    if not triangles or any(block.dtype.kind not in "iu" for block in triangles):
        raise InvalidInputError(f"{path}: expected triangles by numbers of their vertices, got none")
    # Not-a-numbers of a damaged file warn when they are cast; the surface refuses them.
    with naming(str(path)), np.errstate(invalid="ignore"):
        return Surface(np.asarray(mesh.points, dtype=float), np.concatenate(triangles).astype(np.int64))


def write_polylines(path: PathLike, lines_mm: FloatArray, frames: npt.NDArray[np.integer]) -> None:
    """Write lines of equally many points, with the frame of each; the file appears whole or not at all.

    Parameters
    ----------
    path : path
        With the suffix .vtk.
    lines_mm : ndarray, shape (n, points, 3)
        In a world whose axes lead left, posterior and superior; stored in single precision.
    frames : ndarray of int, shape (n,)
        Numbers that lines may be coloured by.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    count, points = lines_mm.shape[:2]
    cells = np.insert(np.arange(count * points).reshape(count, points), 0, points, axis=1)
    pieces = (
        f"# vtk DataFile Version 4.2\nspeckle3d lines. {SPACE}\nBINARY\nDATASET POLYDATA\n".encode(),
        f"POINTS {count * points} float\n".encode(),
        lines_mm.astype(">f4").tobytes(),
        f"\nLINES {count} {cells.size}\n".encode(),
        cells.astype(">i4").tobytes(),
        f"\nCELL_DATA {count}\nSCALARS frame float 1\nLOOKUP_TABLE default\n".encode(),
        frames.astype(">f4").tobytes(),
    )
    with atomic_path(path) as part:
        part.write_bytes(b"".join(pieces) + b"\n")


def write_transform(path: PathLike, world_from_image: RigidTransform) -> None:
    """Write one pose as a transform of ITK; the file appears whole or not at all.

    Parameters
    ----------
    path : path
        Ends in .tfm.
    world_from_image : RigidTransform
        A single pose; its world's axes lead left, posterior and superior; mm.

    Raises
    ------
    InvalidInputError
        If the suffix is another, or the pose is a row of poses: Slicer reads one transform of a file.
    FileError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_transform(f"{folder}/t.tfm", RigidTransform.from_translation([1.0, 2.0, 3.0]))
    ...     print(Path(f"{folder}/t.tfm").read_text().splitlines()[3])
    Parameters: 1 0 0 0 1 0 0 0 1 -1 -2 -3
    """
    require_suffix(path, [".tfm"])
    if not world_from_image.single:
        raise InvalidInputError(f"{path}: expected one pose, got a row of {len(world_from_image)}")
    matrix = world_from_image.inv().as_matrix()
    # Matrix, row by row, and translation.
    parameters = np.concatenate((matrix[:3, :3].ravel(), matrix[:3, 3]))
    lines = (
        "#Insight Transform File V1.0",
        "#Transform 0",
        "Transform: AffineTransform_double_3_3",  # rigid, of the type that all of ITK's readers know
        f"Parameters: {number_text(parameters)}",
        "FixedParameters: 0 0 0",
    )
    with atomic_path(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="ascii")
