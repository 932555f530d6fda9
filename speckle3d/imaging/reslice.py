"""Reslices: any plane through a sweep, straight from its frames or from voxels.

Resliced from the frames, each pixel blends the two images nearest to it, one on either side, sampled
bilinearly where the pixel projects onto them: no voxels, no hole filling, and the images' own resolution.
"""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.sweep import ImageGrid
from speckle3d.core.volume import Volume
from speckle3d.imaging.images import ChosenImages, Images, PosedImages, require_poses

MAX_PIXELS = 100_000_000
"""Largest reslice, to catch wrong units: 100 mm x 100 mm at 0.01 mm."""

DEFAULT_PIXEL_MM = 0.2
"""Between the axial and the lateral resolution of a 5-10 MHz probe."""

_THREADS = 2
_BATCH = 16
"""Images read at a time: enough for milliseconds of work per thread, few enough for memory."""


class _Band:
    """Some rows of a plane: of each pixel the nearest images' distances and levels, behind and in front."""

    def __init__(self, first: int, last: int, columns: int, max_distance_mm: float) -> None:
        self.first = first
        self.distance_mm = np.full((2, last - first, columns), max_distance_mm, dtype=np.float32)
        self.grey = np.full((2, last - first, columns), np.nan, dtype=np.float32)


@dataclass(frozen=True)
class ReslicePlane:
    """A rectangle in the world and the pixels it is cut into.

    Parameters
    ----------
    world_from_plane : RigidTransform, single
        The plane's origin is the centre of its first pixel, x runs along a row (columns grow), y down a
        column (rows grow), z is the normal. Translation in mm.
    width_mm, height_mm : float
        Distance between the centres of the first and the last pixel of a row and of a column, to the
        nearest whole pixel.
    pixel_mm : float
        Spacing of the square pixels.

    Raises
    ------
    InvalidInputError
        If a size is not positive and finite, or the plane has more than `MAX_PIXELS` pixels.
    """

    world_from_plane: RigidTransform
    width_mm: float
    height_mm: float
    pixel_mm: float

    def __post_init__(self) -> None:
        if not self.world_from_plane.single:
            raise InvalidInputError("world_from_plane: expected a single transform, got a row of them")
        for name in ("width_mm", "height_mm", "pixel_mm"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InvalidInputError(f"{name}: expected a value above zero, got {value}")
        if (self.width_mm / self.pixel_mm + 1) * (self.height_mm / self.pixel_mm + 1) > MAX_PIXELS:
            raise InvalidInputError(
                f"reslice of {self.width_mm:g} x {self.height_mm:g} mm: expected at most {MAX_PIXELS} "
                f"pixels, got more with pixels of {self.pixel_mm:g} mm"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (rows, columns) of the resliced image."""
        return round(self.height_mm / self.pixel_mm) + 1, round(self.width_mm / self.pixel_mm) + 1

    def world_from_pixel(self) -> FloatArray:
        """Affine map from (column, row, 1) to homogeneous world coordinates in mm, shape (4, 3)."""
        matrix = self.world_from_plane.as_matrix()[:, [0, 1, 3]]
        return np.asarray(matrix * [self.pixel_mm, self.pixel_mm, 1.0])


def reslice_frames(
    images: Images,
    grid: ImageGrid,
    world_from_image: RigidTransform,
    plane: ReslicePlane,
    max_distance_mm: float,
) -> Float32Array:
    """Cut a plane through a sweep's images.

    One pass over the images, in any order, with memory for the plane and a few images; images too far from
    the plane are not even read. A pixel between two images is interpolated linearly by its distances to
    their planes; with support on one side only it takes that image's level.

    Parameters
    ----------
    images : indexable or callable
        Grey images by frame number, shape (vector, sample); see `speckle3d.imaging.images.Images`.
    grid : ImageGrid
    world_from_image : RigidTransform, length n
    plane : ReslicePlane
    max_distance_mm : float
        Images this far from a pixel or farther do not count: about the distance between frames.

    Returns
    -------
    ndarray of float32, shape (rows, columns)
        NaN where no image is near enough.

    Raises
    ------
    InvalidInputError
        If `max_distance_mm` is not positive, or images and poses do not fit together.

    References
    ----------
    .. [1] W. Wein et al., "Backward-warping ultrasound reconstruction for improving diagnostic value and
       registration", MICCAI, 2006.
    """
    from speckle3d.kernels.slicing import keep_nearest

    if not (np.isfinite(max_distance_mm) and max_distance_mm > 0):
        raise InvalidInputError(f"max_distance_mm: expected a value above zero, got {max_distance_mm}")
    source = PosedImages(images, grid, world_from_image)
    maps = _index_from_pixel(source, plane)
    near = np.flatnonzero(_touches(maps, grid, plane, max_distance_mm))
    cuts = np.linspace(0, plane.shape[0], _THREADS + 1).astype(int)
    bands = [_Band(first, last, plane.shape[1], max_distance_mm) for first, last in itertools.pairwise(cuts)]

    def fill(band: _Band) -> None:
        for image, index in zip(images_read, batch, strict=True):
            shifted = maps[index].copy()
            shifted[:, 2] += band.first * shifted[:, 1]
            keep_nearest(image, shifted, max_distance_mm, band.distance_mm, band.grey)

    with ThreadPoolExecutor(_THREADS) as pool:
        for start in range(0, len(near), _BATCH):
            batch = near[start : start + _BATCH]
            images_read = [source.read(int(index)) for index in batch]
            list(pool.map(fill, bands))
    return np.concatenate([_blend(band.distance_mm, band.grey) for band in bands])


def resample_image(images: Images, frame: int, grid: ImageGrid, pixel_mm: float) -> Float32Array:
    """One image on square pixels, as a reslice through its own plane shows it.

    Returns
    -------
    ndarray of float32, shape (rows, columns)
    """
    plane = image_plane(RigidTransform.identity(), grid, pixel_mm)
    alone = ChosenImages(images, np.array([frame]))
    return reslice_frames(alone, grid, RigidTransform.identity(1), plane, 1.0)


def reslice_volume(volume: Volume, plane: ReslicePlane) -> Float32Array:
    """Cut a plane through voxels, linear between them.

    Parameters
    ----------
    volume : Volume
    plane : ReslicePlane

    Returns
    -------
    ndarray of float32, shape (rows, columns)
        NaN outside the volume and beside NaN voxels.
    """
    index_from_pixel = np.linalg.solve(volume.world_from_index, plane.world_from_pixel())[:3]
    rows, columns = np.indices(plane.shape, dtype=np.float64, sparse=True)
    # NumPy adds the sparse row and column terms: no array of homogeneous pixels is made.
    index = np.stack([a * columns + b * rows + c for a, b, c in index_from_pixel])
    cut = map_coordinates(volume.voxels, index, output=np.float32, order=1, cval=np.nan)
    return np.asarray(cut, dtype=np.float32)


def image_plane(world_from_image: RigidTransform, grid: ImageGrid, pixel_mm: float) -> ReslicePlane:
    """The plane of one image, as large as the image: what another sweep shows there."""
    top = RigidTransform.from_translation([0.0, grid.first_sample_depth_mm, 0.0])
    height = grid.depth_mm - grid.first_sample_depth_mm
    return ReslicePlane(world_from_image * top, grid.width_mm, height, pixel_mm)


def along_sweep_plane(
    world_from_image: RigidTransform,
    grid: ImageGrid,
    lateral_mm: float,
    pixel_mm: float = DEFAULT_PIXEL_MM,
) -> ReslicePlane:
    """Plane along the sweep and into the depth, in which its length and tilt are seen.

    Columns follow the sweep's mean elevational travel at the lateral position `lateral_mm`, rows the mean
    axial direction; the plane covers that line of every image.

    Parameters
    ----------
    world_from_image : RigidTransform, length n
    grid : ImageGrid
    lateral_mm : float
        From the first vector, inside the image.
    pixel_mm : float

    Raises
    ------
    InvalidInputError
        If `lateral_mm` is outside the image, or there are no poses.
    InsufficientDataError
        If the poses have no common axial or elevational direction.
    """
    _require_inside("lateral_mm", lateral_mm, 0.0, grid.width_mm)
    top, bottom = grid.first_sample_depth_mm, grid.depth_mm
    line = np.array([[lateral_mm, top, 0.0], [lateral_mm, bottom, 0.0]])
    return _plane_along(world_from_image, line, pixel_mm)


def surface_plane(
    world_from_image: RigidTransform,
    grid: ImageGrid,
    depth_mm: float,
    pixel_mm: float = DEFAULT_PIXEL_MM,
) -> ReslicePlane:
    """Plane along the sweep at one depth, in which its length and yaw are seen.

    Columns follow the sweep's mean elevational travel at the depth `depth_mm`, rows the mean lateral
    direction; the plane covers that line of every image.

    Parameters
    ----------
    world_from_image : RigidTransform, length n
    grid : ImageGrid
    depth_mm : float
        Inside the image.
    pixel_mm : float

    Raises
    ------
    InvalidInputError
        If `depth_mm` is outside the image, or there are no poses.
    InsufficientDataError
        If the poses have no common lateral or elevational direction.
    """
    _require_inside("depth_mm", depth_mm, grid.first_sample_depth_mm, grid.depth_mm)
    line = np.array([[0.0, depth_mm, 0.0], [grid.width_mm, depth_mm, 0.0]])
    return _plane_along(world_from_image, line, pixel_mm)


def _index_from_pixel(source: PosedImages, plane: ReslicePlane) -> FloatArray:
    """Per image, the map from the plane's (column, row, 1) to (vector, sample, distance in mm): (n, 3, 3)."""
    image_from_world = source.world_from_image.inv().as_matrix()
    maps = source.index_from_image() @ image_from_world @ plane.world_from_pixel()
    # "Behind" and "in front" must mean the same for all images, or neighbours of opposite facing
    # (a probe turned round between two passes) would compete for one side and leave the other empty.
    normal = image_from_world[:, 2, :3]
    turned = normal @ normal.sum(axis=0) < 0
    maps[turned, 2] *= -1.0
    return np.ascontiguousarray(maps)


def _touches(maps: FloatArray, grid: ImageGrid, plane: ReslicePlane, max_distance_mm: float) -> BoolArray:
    """Whether each image's slab can reach the rectangle: no slab face has all four corners beyond it."""
    rows, columns = plane.shape
    corners = np.array([[0, 0, 1], [columns - 1, 0, 1], [0, rows - 1, 1], [columns - 1, rows - 1, 1]])
    u, v, q = np.moveaxis(maps @ corners.T, 1, 0)
    reach = (
        (u, 0.0, grid.vectors - 1.0),
        (v, 0.0, grid.samples - 1.0),
        (q, -max_distance_mm, max_distance_mm),
    )
    near = [(c.max(axis=1) > low - 1e-3) & (c.min(axis=1) < high + 1e-3) for c, low, high in reach]
    return np.asarray(near[0] & near[1] & near[2])


def _blend(distance_mm: Float32Array, grey: Float32Array) -> Float32Array:
    """Interpolate between the nearest images of either side, or take the only one there is."""
    gap = distance_mm.sum(axis=0)
    share = np.divide(distance_mm[0], gap, out=np.zeros_like(gap), where=gap > 0)
    between = grey[0] + share * (grey[1] - grey[0])
    alone = np.where(np.isnan(grey[0]), grey[1], grey[0])
    return np.asarray(np.where(np.isnan(between), alone, between), dtype=np.float32)


def _plane_along(world_from_image: RigidTransform, line_mm: FloatArray, pixel_mm: float) -> ReslicePlane:
    """Plane that covers one line of every image; columns along the mean travel, rows along the line."""
    require_poses(world_from_image)
    ends = np.stack([world_from_image.apply(point) for point in line_mm])
    down = _unit((ends[1] - ends[0]).mean(axis=0), "the line to show")
    travel = _mean_travel(ends.mean(axis=0), world_from_image)
    across = _unit(travel - (travel @ down) * down, "travel")
    axes = np.column_stack([across, down, np.cross(across, down)])
    points = ends.reshape(-1, 3) @ axes
    low, high = points.min(axis=0), points.max(axis=0)
    origin = axes @ [low[0], low[1], points[:, 2].mean()]
    width, height = np.maximum(high - low, pixel_mm)[:2]
    placed = RigidTransform.from_components(origin, Rotation.from_matrix(axes))
    return ReslicePlane(placed, float(width), float(height), pixel_mm)


def _mean_travel(points_mm: FloatArray, world_from_image: RigidTransform) -> FloatArray:
    """Mean travel per mm forward, by regressing position on elevational position; order does not matter."""
    normal = world_from_image.rotation.apply([0.0, 0.0, 1.0]).mean(axis=0)
    forward = _unit(normal, "elevational")
    moved = points_mm - points_mm.mean(axis=0)
    elevation = moved @ forward
    spread = float(elevation @ elevation)
    if spread <= 1e-6 * len(points_mm):  # a micrometre rms is no travel to take a direction from
        return forward
    return np.asarray(elevation @ moved / spread)


def _unit(vector: FloatArray, what: str) -> FloatArray:
    length = float(np.linalg.norm(vector))
    if length < 1e-6:
        raise InsufficientDataError(f"the poses have no common direction of {what}: expected one sweep")
    return np.asarray(vector / length)


def _require_inside(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise InvalidInputError(
            f"{name}: expected a value inside the image, {low:g} to {high:g}, got {value:g}"
        )
