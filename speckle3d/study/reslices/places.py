"""Where to cut a sweep or a volume, as a person asks for it, and what the cut's axes are called."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.volume import Volume
from speckle3d.imaging.cuts.curved import CurvedSheet, curved_sheet
from speckle3d.imaging.cuts.oblique import (
    covering_box,
    covering_plane,
    spanned_plane,
    three_point_plane,
    turned_frame_plane,
    vector_words,
)
from speckle3d.imaging.cuts.outlines import crossings, frame_outlines
from speckle3d.imaging.cuts.planes import (
    DEFAULT_PIXEL_MM,
    ReslicePlane,
    depth_line,
    lateral_line,
    planes_from_first_frame,
)

AnyCut = ReslicePlane | CurvedSheet
Vector = FloatArray | tuple[float, float, float]

_SAME_DIRECTION = np.cos(np.deg2rad(20.0))
"""An axis goes by the name of a direction of the sweep within so much of it."""

_VIEWS = {
    "lateral": ("the first vector's side", "the last vector's side"),
    "depth": ("the probe", "below"),
    "along the sweep": ("behind the frames", "before the frames"),
}
"""Whence one looks along a direction of the sweep, and against it."""


@dataclass(frozen=True)
class Place:
    """Where to cut: one of these; with none, along the sweep at the middle of the image.

    Attributes
    ----------
    lateral_mm : float, optional
        Along the sweep and into the depth; with `frame`, where the axis lies about which the plane is turned.
    depth_mm : float, optional
        Along the sweep at one depth.
    frame : int, optional
        In a frame, counted among those with a pose, turned out of it by `angle_deg` about its depth line: 90
        is along the sweep.
    angle_deg : float
    points_mm : ndarray, shape (3, 3), optional
        Through three points of the world.
    origin_mm, right, down : tuple of float or ndarray, shape (3,), optional
        From a point of the world along two directions.
    curve_mm : ndarray, shape (n, 3), optional
        Along a curve through points of the world, and down into the depth, or along `down`.
    smooth : bool
        Join the curve's points by a spline.
    pixel_mm : float
    reach_mm : float
        Frames farther from a pixel do not count.
    """

    lateral_mm: float | None = None
    depth_mm: float | None = None
    frame: int | None = None
    angle_deg: float = 0.0
    points_mm: FloatArray | None = None
    origin_mm: Vector | None = None
    right: Vector | None = None
    down: Vector | None = None
    curve_mm: FloatArray | None = None
    smooth: bool = True
    pixel_mm: float = DEFAULT_PIXEL_MM
    reach_mm: float = 0.5

    def cuts(self, poses: Mapping[str, RigidTransform], grid: ImageGrid, reference: str) -> dict[str, AnyCut]:
        """Place the cut at the poses of every mode, by the frame it hangs on: the first or the one named.

        Points and directions are those of the reference's world.

        Raises
        ------
        InvalidInputError
            If the place is incomplete, or not in the sweep.
        """
        if self.is_along_sweep:
            depth, lateral = self.depth_mm, self._lateral(grid)
            line = lateral_line(grid, lateral) if depth is None else depth_line(grid, depth)
            return dict(planes_from_first_frame(poses, line, self.pixel_mm))
        there = poses[reference]
        frame = 0 if self.frame is None else self.frame
        cut = self._in_world(grid, there)
        return {mode: _moved(cut, each[frame] * there[frame].inv()) for mode, each in poses.items()}

    def counted_in(self, numbers: IntArray) -> Place:
        """The same place with its frame counted among those that have a pose.

        Raises
        ------
        InvalidInputError
            If the frame has none.
        """
        if self.frame is None:
            return self
        at = np.flatnonzero(numbers == self.frame)
        if not at.size:
            gaps = ", with gaps" if np.ptp(numbers) >= len(numbers) else ""
            raise InvalidInputError(
                f"--frame: expected one with a pose, {numbers[0]} to {numbers[-1]}{gaps}, got {self.frame}"
            )
        return replace(self, frame=int(at[0]))

    def cut_of_box(self, volume: Volume) -> AnyCut:
        """Place the cut in a volume, as large as it shows of that; by default the middle of i and j.

        Raises
        ------
        InvalidInputError
            If the place is one in frames, or misses the volume.
        """
        if any(each is not None for each in (self.lateral_mm, self.depth_mm, self.frame)):
            raise InvalidInputError(
                "expected --points, --origin or --curve for a volume, got a place in frames: it has none"
            )
        corners = np.array(list(product(*([0, n - 1] for n in volume.shape))), dtype=float)
        corners = corners @ volume.world_from_index[:3, :3].T + volume.world_from_index[:3, 3]
        if self.curve_mm is not None:
            down = self.down if self.down is not None else volume.world_from_index[:3, 1]
            return self._swept(down, corners)
        if self.points_mm is not None or self.origin_mm is not None:
            return covering_box(self._spanned(), corners, self.pixel_mm)
        middle = RigidTransform.from_translation([0, 0, (volume.shape[2] - 1) / 2 * volume.spacing_mm[2]])
        return covering_box(volume.world_from_grid * middle, corners, self.pixel_mm)

    def axes(self, cut: AnyCut, world_from_image: RigidTransform) -> tuple[str, str]:
        """Names of the cut's axes: by how it was placed, else by the directions of the sweep they follow."""
        if isinstance(cut, CurvedSheet):
            return "along the curve", _name(cut.down, world_from_image)
        if self.is_along_sweep:
            return "along the sweep", "depth" if self.depth_mm is None else "lateral"
        right, down = cut.world_from_plane.rotation.as_matrix().T[:2]
        return _name(right, world_from_image), _name(down, world_from_image)

    @property
    def is_along_sweep(self) -> bool:
        """Whether nothing else is asked for than a lateral position or a depth."""
        placed = (self.frame, self.points_mm, self.origin_mm, self.curve_mm)
        return all(each is None for each in placed)

    def words(self, grid: ImageGrid | None = None) -> str:
        """Where the cut is."""
        if self.frame is not None:
            turned = f", turned by {self.angle_deg:g}°" if self.angle_deg else ""
            return f"plane of frame {self.frame}{turned}"
        if self.points_mm is not None:
            return "plane through three points"
        if self.origin_mm is not None:
            return f"plane from {vector_words(self.origin_mm)} mm"
        if self.curve_mm is not None:
            return f"along a curve through {len(self.curve_mm)} points"
        if self.depth_mm is not None:
            return f"at depth {self.depth_mm:g} mm"
        return "middle plane of i and j" if grid is None else f"at lateral {self._lateral(grid):.4g} mm"

    def _lateral(self, grid: ImageGrid) -> float:
        return float(grid.extent_mm[:, 0].mean()) if self.lateral_mm is None else self.lateral_mm

    def _in_world(self, grid: ImageGrid, there: RigidTransform) -> AnyCut:
        if self.curve_mm is not None:
            return self._sheet(grid, there)
        if self.frame is None:
            return covering_plane(self._spanned(), grid, there, self.reach_mm, self.pixel_mm)
        (lateral, _, _), _ = lateral_line(grid, self._lateral(grid))
        placed = turned_frame_plane(there[self.frame], lateral, self.angle_deg)
        plane = covering_plane(placed, grid, there, self.reach_mm, self.pixel_mm)
        # In a frame itself x counts from the first vector.
        left = 0.0 if self.angle_deg else lateral
        return replace(plane, first_mm=(plane.first_mm[0] + left, plane.first_mm[1]))

    def _spanned(self) -> RigidTransform:
        if self.points_mm is not None:
            return three_point_plane(self.points_mm)
        if self.origin_mm is None or self.right is None or self.down is None:
            raise InvalidInputError("expected --right and --down, directions of the plane, beside --origin")
        return spanned_plane(self.origin_mm, self.right, self.down)

    def _sheet(self, grid: ImageGrid, there: RigidTransform) -> CurvedSheet:
        down = mean_directions(there)[1] if self.down is None else self.down
        sheet = self._swept(down, frame_outlines(grid, there).reshape(-1, 3))
        if self.down is not None:
            return sheet
        # Depth counts from the probe where the curve begins, as the nearest frame has it.
        at = there.inv().apply(np.asarray(self.curve_mm)[0])
        depth = float(at[np.argmin(np.abs(at[:, 2])), 1])
        return replace(sheet, first_mm=(0.0, sheet.first_mm[1] + depth))

    def _swept(self, down: Vector, around_mm: FloatArray) -> CurvedSheet:
        """Sweep the curve as far along its columns as there is something."""
        points = np.asarray(self.curve_mm, dtype=float)
        along = (
            (around_mm - points[:1].sum(axis=0)) @ np.asarray(down) / max(float(np.linalg.norm(down)), 1e-9)
        )
        return curved_sheet(points, down, (along.min(), along.max()), self.pixel_mm, self.smooth)


def mean_directions(world_from_image: RigidTransform) -> FloatArray:
    """Mean lateral, axial and elevational direction of frames, shape (3, 3), a unit vector each."""
    axes = world_from_image.rotation.as_matrix().mean(axis=0).T
    return np.asarray(axes / np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-9))


def view_of(cut: AnyCut, world_from_image: RigidTransform) -> str:
    """Whence one looks at a plane: "seen from the probe", or nothing where that has no name."""
    if isinstance(cut, CurvedSheet):
        return ""
    # A picture's x runs right and its y down, so its normal leads away from who looks at it.
    name, same_way = _direction(cut.world_from_plane.rotation.apply([0.0, 0.0, 1.0]), world_from_image)
    return f"seen from {_VIEWS[name][0 if same_way else 1]}" if name else ""


def frame_lines(cut: AnyCut, grid: ImageGrid, world_from_image: RigidTransform) -> FloatArray:
    """Lines in which frames cross a plane, by its axes, (n, 2, 2), mm; NaN for none; none on a sheet."""
    if isinstance(cut, CurvedSheet):
        return np.empty((0, 2, 2))
    lines = crossings(frame_outlines(grid, world_from_image), cut.world_from_plane)
    return np.asarray(lines + np.array(cut.first_mm))


def sweep_extent(world_from_image: RigidTransform, grid: ImageGrid) -> str:
    """Where a sweep lies, in words."""
    outlines = frame_outlines(grid, world_from_image)
    return (
        f"between {vector_words(outlines.min(axis=(0, 1)))} and {vector_words(outlines.max(axis=(0, 1)))} mm"
    )


def _moved(cut: AnyCut, move: RigidTransform) -> AnyCut:
    if isinstance(cut, CurvedSheet):
        return replace(cut, base_mm=move.apply(cut.base_mm), down=move.rotation.apply(cut.down))
    return replace(cut, world_from_plane=move * cut.world_from_plane)


def _direction(direction: FloatArray, world_from_image: RigidTransform) -> tuple[str, bool]:
    """Direction of the sweep that another one follows, and whether both point the same way."""
    names = tuple(_VIEWS)
    alike = mean_directions(world_from_image) @ direction
    best = int(np.argmax(np.abs(alike)))
    return names[best] if abs(alike[best]) > _SAME_DIRECTION else "", bool(alike[best] > 0)


def _name(direction: FloatArray, world_from_image: RigidTransform) -> str:
    name, same_way = _direction(direction, world_from_image)
    return (name or "in the plane") if same_way or not name else f"{name}, backwards"
