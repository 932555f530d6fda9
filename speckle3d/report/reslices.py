"""Reslices along a sweep at the poses of every mode, and one detail of each enlarged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.core.sweep import ImageGrid
from speckle3d.imaging.reslice import ReslicePlane
from speckle3d.report.data import SweepView
from speckle3d.study.images import PIXEL_MM, GreyImages, cut_frames, grey_images, middle_plane, middle_vectors

DETAIL_PIXEL_MM = 0.04
DETAIL_MM = 5.0
"""Widest enlarged detail; four fifths as high."""

_DETAIL_SHARE = 0.4
"""Largest width of the detail as a share of the shortest reslice."""

NEAR_FIELD_MM = 4.0
_DYNAMIC_RANGE_DB = 55.0


@dataclass(frozen=True)
class Cut:
    """A reslice, its enlarged detail and where in the reslice that lies.

    Attributes
    ----------
    image, detail : ndarray of float32, shape (rows, columns)
        Grey levels 0 to 255, NaN where no frame reached.
    extent_mm : (width, height)
    corner_mm, size_mm : ndarray, shape (2,)
        Top left of the detail, along the sweep and in depth from the reslice's own top left, and its sides.
    """

    image: Float32Array
    extent_mm: tuple[float, float]
    detail: Float32Array
    corner_mm: FloatArray
    size_mm: FloatArray


@dataclass(frozen=True)
class Cuts:
    """The cuts of all modes, and one image of the sweep."""

    by_mode: dict[str, Cut]
    depth_mm: float
    middle: Float32Array
    grid: ImageGrid


class _Strip:
    """The middle vectors of every grey image, made once for all modes."""

    def __init__(self, images: GreyImages) -> None:
        first, self.grid = middle_vectors(images.grid)
        self.left_mm = first * self.grid.vector_pitch_mm
        chosen = slice(first, first + self.grid.vectors)
        # Each frame is made only to be cut: a sweep of a thousand whole images need not fit in memory.
        self._images = [np.rint(images[i][chosen]).astype(np.uint8) for i in range(images.shape[0])]
        self.shape = (len(self._images), *self._images[0].shape)

    def __getitem__(self, index: int) -> Float32Array:
        return self._images[index].astype(np.float32)


def cut_modes(view: SweepView) -> Cuts | None:
    """Reslice the sweep at its middle vector in every mode; None where the sweep itself is gone.

    The detail shows the place of most contrast in the most trusted trajectory (the reference, else the last
    mode), and the same place of the same frame in all others.
    """
    if view.sweep is None:
        return None
    images = grey_images(view.sweep, _DYNAMIC_RANGE_DB, reconstruction=view.reconstruction)
    strip = _Strip(images)
    left = RigidTransform.from_translation([strip.left_mm, 0.0, 0.0])
    poses = {mode: each * left for mode, each in view.own_poses.items()}
    planes = {mode: middle_plane(each, strip.grid) for mode, each in poses.items()}
    whole = {mode: cut_frames(strip, strip.grid, poses[mode], planes[mode]) for mode in poses}
    width_mm = min(DETAIL_MM, _DETAIL_SHARE * min(plane.width_mm for plane in planes.values()))
    size_mm = np.array([1.0, 0.8]) * max(width_mm, 10 * DETAIL_PIXEL_MM)
    last = list(planes)[-1]
    frame, depth_mm = _detail_place(poses[last], planes[last], whole[last], strip.grid, size_mm)
    by_mode = {}
    for mode, plane in planes.items():
        point = np.array([strip.grid.width_mm / 2, depth_mm, 0.0])
        centre = plane.world_from_plane.inv().apply(poses[mode][frame].apply(point))[:2]
        corner = centre - size_mm / 2
        detail = cut_frames(strip, strip.grid, poses[mode], _window(plane, corner, size_mm))
        by_mode[mode] = Cut(whole[mode], (plane.width_mm, plane.height_mm), detail, corner, size_mm)
    return Cuts(by_mode, depth_mm, images[len(view.sweep) // 2], images.grid)


def _window(plane: ReslicePlane, corner_mm: FloatArray, size_mm: FloatArray) -> ReslicePlane:
    shift = RigidTransform.from_translation([*corner_mm, 0.0])
    return ReslicePlane(plane.world_from_plane * shift, float(size_mm[0]), float(size_mm[1]), DETAIL_PIXEL_MM)


def _detail_place(
    poses: RigidTransform, plane: ReslicePlane, image: Float32Array, grid: ImageGrid, size_mm: FloatArray
) -> tuple[int, float]:
    """Frame and depth of the place with most contrast between its parts, speckle smoothed away."""
    seen = np.isfinite(image)
    if not seen.any():
        return len(poses) // 2, float(grid.centre_mm[1])
    # Where nothing was seen, the mean stands in, or the rim would have the greatest contrast.
    smooth = gaussian_filter(np.where(seen, image, image[seen].mean()), 0.4 / PIXEL_MM)
    size = [max(1, round(side / PIXEL_MM)) for side in size_mm[::-1]]
    spread = uniform_filter(smooth**2, size) - uniform_filter(smooth, size) ** 2
    # Only windows that lie wholly on images: the rim of the reslice has contrast but no content.
    inside = uniform_filter(seen.astype(float), size, mode="constant") > 0.999
    # The contrast of the near field is the probe's own.
    inside[: int((NEAR_FIELD_MM + size_mm[1] / 2) / PIXEL_MM)] = False
    if not inside.any():
        return len(poses) // 2, float(grid.centre_mm[1])
    row, column = np.unravel_index(int(np.argmax(np.where(inside, spread, -1.0))), image.shape)
    point = plane.world_from_plane.apply([column * PIXEL_MM, row * PIXEL_MM, 0.0])
    in_image = poses.inv().apply(point)
    frame = int(np.argmin(np.abs(in_image[:, 2])))
    return frame, float(np.clip(in_image[frame, 1], grid.first_sample_depth_mm, grid.depth_mm))
