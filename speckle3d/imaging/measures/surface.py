"""Surfaces of a volume: where its grey level crosses a threshold, or around its labels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array, diags_array

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.core.grid import ImageGrid
from speckle3d.core.poses import PoseErrors
from speckle3d.core.surface import Surface
from speckle3d.core.volume import Volume
from speckle3d.imaging.measures.belonging import belonging_of, changes

Inside = Literal["above", "below"]
TAUBIN = (0.5, -0.53)
"""Shares of the way to the neighbours' mean that a vertex goes, in and out again, in a pass of smoothing."""
MAX_LABELS = 200
"""Each label gets a file, and organs are segmented into 120; a volume of 8 bits has some 250 grey levels."""


def surface_of(
    volume: Volume,
    level: float,
    inside: Inside = "above",
    known: BoolArray | None = None,
    smooth: int = 0,
) -> Surface:
    """Surface on which the grey level, interpolated linearly between voxels, is `level`.

    Empty voxels are not below the level, but unknown: where the sweep ends the surface ends, too, and stays
    open (`Surface.open_edges`).

    Parameters
    ----------
    volume : Volume
    level : float
        In the volume's own grey levels.
    inside : {"above", "below"}
        Whether the inside is brighter than the level, or darker, as of a cyst or a vessel.
    known : ndarray of bool, optional
        Voxels with a value, in the volume's shape; without it as `known_voxels` has them.
    smooth : int
        Passes of smoothing; see `smooth_surface`.

    Returns
    -------
    Surface
        Vertices in the world, mm.

    Raises
    ------
    InvalidInputError
        If `level` is not among the grey levels.
    InsufficientDataError
        If there is no surface.

    References
    ----------
    .. [1] T. Lewiner et al., "Efficient implementation of marching cubes' cases with topological guarantees",
       Journal of Graphics Tools 8, 2003.

    Examples
    --------
    >>> from scipy.spatial.transform import RigidTransform
    >>> away = np.linalg.norm(np.mgrid[:21, :21, :21] - 10.0, axis=0)
    >>> ball = Volume((20.0 - away).astype(np.float32), (0.5, 0.5, 0.5), RigidTransform.identity())
    >>> surface = surface_of(ball, level=12.0)  # 8 voxels, 4 mm from the centre
    >>> round(surface.volume_mm3), round(4 / 3 * np.pi * 4**3)
    (266, 268)
    """
    known = known_voxels(volume) if known is None else known
    if smooth < 0 or known.shape != volume.shape:
        raise InvalidInputError(
            f"surface: expected zero or more passes of smoothing and known voxels of shape {volume.shape}, "
            f"got {smooth} and {known.shape}"
        )
    values = volume.voxels[known]
    if not (values.size and values.min() <= level <= values.max()):
        among = f"{values.min():g} to {values.max():g}" if values.size else "of which there is none"
        raise InvalidInputError(f"level: expected a grey level of the volume, {among}, got {level:g}")
    surface = _march(volume, volume.voxels, level, inside, known)
    return smooth_surface(surface, smooth) if smooth else surface


def surfaces_of_labels(volume: Volume, known: BoolArray | None = None) -> dict[int, Surface]:
    """Surfaces around each label of a label map, by label; 0 is no label.

    A label that reaches the border of the grid, or of the `known` voxels, is open there.

    Raises
    ------
    InvalidInputError
        If the voxels are no labels.
    InsufficientDataError
        If there is no label.
    """
    voxels = volume.voxels
    labels = np.unique(voxels)
    if not np.array_equal(labels, np.rint(labels)) or len(labels) > MAX_LABELS:
        raise InvalidInputError(
            f"labels: expected at most {MAX_LABELS} whole numbers, got {len(labels)} values: are these grey "
            "levels?"
        )
    mask, surfaces = np.ones(volume.shape, dtype=bool) if known is None else known, {}
    for label in labels[labels != 0].astype(int).tolist():
        surface = _march(volume, (voxels == label).astype(np.float32), 0.5, "above", mask)
        surfaces[label] = replace(surface, fields={**surface.fields, "label": str(label)})
    if not surfaces:
        raise InsufficientDataError("labels: expected voxels other than 0, got none")
    return surfaces


def known_voxels(volume: Volume) -> BoolArray:
    """Mask of voxels that have a value, as far as the volume itself shows.

    Of float32 those that are not NaN. Of whole numbers an empty voxel is 0, and so is black: zeros that are
    connected with the border of the grid are taken for empty, and those enclosed for black.
    """
    voxels = volume.voxels
    if voxels.dtype.kind == "f":
        return np.asarray(np.isfinite(voxels))
    return np.asarray(ndimage.binary_fill_holes(voxels != 0))


def smooth_surface(surface: Surface, passes: int) -> Surface:
    """Smooth a surface: each vertex towards its neighbours' mean and back out, so that it hardly shrinks.

    Vertices of open borders stay.

    References
    ----------
    .. [1] G. Taubin, "A signal processing approach to fair surface design", SIGGRAPH, 1995.
    """
    n, edges = len(surface.vertices_mm), surface.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = np.concatenate([edges, edges[:, ::-1]])
    neighbours = coo_array((np.ones(len(edges)), edges.T), shape=(n, n)).tocsr()
    neighbours.data[:] = 1.0
    mean = diags_array(1.0 / np.maximum(neighbours.sum(axis=1), 1.0)) @ neighbours
    free = ~np.isin(np.arange(n), surface.open_edges())[:, None]
    vertices = surface.vertices_mm
    for _ in range(passes):
        for share in TAUBIN:
            vertices = vertices + share * free * (mean @ vertices - vertices)
    return replace(surface, vertices_mm=vertices)


@dataclass(frozen=True)
class PartMeasures:
    """Size of a surface or a part of it.

    Attributes
    ----------
    triangles : int
    area_mm2 : float
    volume_mm3 : float or None
        What closed parts enclose, less cavities; None if none is closed.
    open_mm : float
        Length of the border along which it is open: where the sweep or the grid cuts it.
    area_sigma_mm2, volume_sigma_mm3 : float or None
        Standard errors by the poses' errors alone; None without these.
    """

    triangles: int
    area_mm2: float
    volume_mm3: float | None
    open_mm: float
    area_sigma_mm2: float | None = None
    volume_sigma_mm3: float | None = None


def measures_of(
    surface: Surface, errors: PoseErrors | None = None, grid: ImageGrid | None = None
) -> PartMeasures:
    """Measure a surface; with its sweep's pose errors and image grid also the standard errors.

    Every vertex moves with the frames nearest to it (`belonging_of`). Area and volume follow to first order.
    The place of the level, the resolution of the images and the voxels' size are not in it.
    """
    edges = surface.open_edges()
    open_mm = float(np.linalg.norm(np.diff(surface.vertices_mm[edges], axis=1), axis=2).sum())
    body = _closed_part(surface, edges)
    volume = body.volume_mm3 if len(body) else None
    area_sigma = volume_sigma = None
    if errors is not None and grid is not None:
        corners = surface.vertices_mm[surface.triangles]
        opposite = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
        area_sigma = _sigma(surface, np.cross(surface.normals[:, None], opposite) / 2.0, errors, grid)
        if volume is not None:
            volume_sigma = _sigma(body, np.repeat(body.normals_mm2 / 3.0, 3, axis=0), errors, grid)
    return PartMeasures(len(surface), surface.area_mm2, volume, open_mm, area_sigma, volume_sigma)


def largest_part(surface: Surface) -> Surface:
    """The connected part with the largest area."""
    part = surface.parts()
    areas = np.bincount(part, np.linalg.norm(surface.normals_mm2, axis=1))
    return surface.of_triangles(part == int(areas.argmax()))


def _closed_part(surface: Surface, open_edges: IntArray) -> Surface:
    """The parts of a surface that have no border, and of cavities those within the bounds of such a part."""
    part = surface.parts()
    middles = surface.vertices_mm[surface.triangles].mean(axis=1)
    inner = np.einsum("ij,ij->i", surface.normals_mm2, middles - middles.mean(axis=0))
    faces_out = np.bincount(part, inner) > 0.0
    numbers = np.arange(len(faces_out))
    whole = ~np.isin(numbers, part[np.isin(surface.triangles, open_edges).any(axis=1)])
    low, high = ndimage.minimum, ndimage.maximum
    bounds = [low(c, part, numbers) for c in middles.T] + [-high(c, part, numbers) for c in middles.T]
    corners = np.stack(bounds, axis=1)
    bodies = corners[whole & faces_out]
    for cavity in np.flatnonzero(whole & ~faces_out):
        whole[cavity] = (bodies <= corners[cavity]).all(axis=1).any()
    return surface.of_triangles(whole[part])


def _sigma(surface: Surface, gradient: FloatArray, errors: PoseErrors, grid: ImageGrid) -> float:
    """Standard error of a quantity from its derivative by each triangle's corners."""
    near = belonging_of(surface.vertices_mm, grid, errors.world_from_image)
    corner = surface.triangles.ravel()
    points, gradient = surface.vertices_mm[corner], gradient.reshape(-1, 3)
    return float(np.linalg.norm(changes(errors, points, gradient, near.of_points(corner))))


def _march(volume: Volume, values: FloatArray, level: float, inside: Inside, mask: BoolArray) -> Surface:
    """Marching cubes over the cells whose eight voxels are in a mask, in the world."""
    marching_cubes = extra_module("skimage.measure", "surface", "a surface").marching_cubes
    if min(volume.shape) < 2:
        raise InsufficientDataError(f"surface: expected two voxels along every axis, got {volume.shape}")
    try:
        # In the order of memory the axes are k, j, i: an odd permutation, which turns triangles over.
        vertices, triangles, _, _ = marching_cubes(
            values.T,
            level,
            spacing=volume.spacing_mm[::-1],
            gradient_direction="descent" if inside == "above" else "ascent",
            # Cells all of whose corners are in it, at the index of the farthest corner.
            mask=ndimage.minimum_filter(mask.T, 2),
        )
    except RuntimeError:
        raise InsufficientDataError(
            f"surface: expected grey levels on both sides of {level:g}, got none"
        ) from None
    world = volume.world_from_grid.apply(vertices[:, ::-1].astype(float))
    side = f"{inside} {level:g}"
    return Surface(world, triangles.astype(np.int64), {**volume.fields, "inside": side})
