"""Volumes and paths of frames for pyvista and napari."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.extras import extra_module

if TYPE_CHECKING:
    from speckle3d.core.sweep import ImageGrid
    from speckle3d.core.volume import Volume


def volume_for_pyvista(volume: Volume) -> Any:
    """Voxels as a grid of pyvista, at their place in the world.

    Returns
    -------
    pyvista.ImageData
        With the point data ``levels``.
    """
    pyvista = extra_module("pyvista", "pyvista", "a grid of pyvista")
    grid = pyvista.ImageData(dimensions=volume.shape, spacing=volume.spacing_mm)
    grid.origin = volume.world_from_grid.translation
    grid.direction_matrix = volume.world_from_grid.rotation.as_matrix()
    grid.point_data["levels"] = volume.voxels.ravel(order="F")
    return grid


def frames_for_pyvista(world_from_image: RigidTransform, grid: ImageGrid) -> Any:
    """Outlines of frames as a mesh of pyvista.

    Returns
    -------
    pyvista.PolyData
        One rectangle for each frame, with the cell data ``frame``.
    """
    pyvista = extra_module("pyvista", "pyvista", "a mesh of pyvista")
    corners = np.concatenate([pose.apply(grid.corners_mm) for pose in world_from_image])
    count = len(world_from_image)
    faces = np.column_stack([np.full(count, 4), np.arange(4 * count).reshape(-1, 4)])
    mesh = pyvista.PolyData(corners, faces=faces.ravel())
    mesh.cell_data["frame"] = np.arange(count)
    return mesh


def volume_for_napari(volume: Volume, viewer: Any = None) -> tuple[Any, dict[str, Any], str]:
    """Voxels as a layer of napari, at their place in the world.

    Parameters
    ----------
    viewer : napari.Viewer, optional
        To which the layer is added.

    Returns
    -------
    tuple
        Layer data: array, keywords, "image". Its axes are the world's x, y and z, mm.
    """
    known = {"name": "speckle3d", "affine": volume.world_from_index, "units": ("mm", "mm", "mm")}
    layer = (volume.voxels, known, "image")
    if viewer is not None:
        viewer.add_image(volume.voxels, **known)
    return layer
