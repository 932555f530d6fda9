"""Places of cuts in a sweep at the poses of every mode, with the names of their axes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.cuts.curved import curved_sheet
from speckle3d.imaging.cuts.oblique import covering_plane, turned_frame_plane, vector_words
from speckle3d.imaging.cuts.outlines import frame_outlines
from speckle3d.imaging.cuts.planes import Cut, depth_line, lateral_line, planes_from_first_frame
from speckle3d.study.posed import SweepModes

DEFAULT_PIXEL_MM = 0.2
"""Between the axial and the lateral resolution of a 5-10 MHz probe."""

_LARGEST_MM = (1000.0, 200.0)
"""Of a cut along the sweep, however far a mode runs away."""

_SAME_DIRECTION = np.cos(np.deg2rad(20.0))
"""An axis goes by the name of a direction of the sweep within so much of it."""


@dataclass(frozen=True)
class Place:
    """One place of a sweep at the poses of several modes.

    Attributes
    ----------
    cuts : mapping of str to Cut
        By mode.
    axes : tuple of str
        Names of x and y, without the unit.
    words : str
        Where it is.
    """

    cuts: Mapping[str, Cut]
    axes: tuple[str, str]
    words: str


def along_sweep(
    modes: SweepModes,
    grid: ImageGrid,
    lateral_mm: float | None = None,
    depth_mm: float | None = None,
    pixel_mm: float = DEFAULT_PIXEL_MM,
) -> Place:
    """Cut along the sweep: into the depth at a lateral position, by default the middle, or at one depth.

    Cuts hang on the first frame, which is at one place in all.
    """
    lateral_mm = float(grid.extent_mm[:, 0].mean()) if lateral_mm is None else lateral_mm
    line, across, words = lateral_line(grid, lateral_mm), "depth", f"at lateral {lateral_mm:.4g} mm"
    if depth_mm is not None:
        line, across, words = depth_line(grid, depth_mm), "lateral", f"at depth {depth_mm:g} mm"
    planes = planes_from_first_frame(modes.poses, line, pixel_mm, _LARGEST_MM)
    return Place(planes, ("along the sweep", across), words)


def in_frame(
    modes: SweepModes,
    grid: ImageGrid,
    frame: int,
    angle_deg: float = 0.0,
    lateral_mm: float | None = None,
    pixel_mm: float = DEFAULT_PIXEL_MM,
) -> Place:
    """Cut in a frame, or turned out of it about its depth line at a lateral position: 90 is along the sweep.

    Raises
    ------
    InvalidInputError
        If the frame has no pose.
    """
    numbers, poses = modes.posed.frames, modes.poses[modes.reference]
    if frame not in numbers:
        raise InvalidInputError(
            f"--frame: expected one with a pose, of {numbers[0]} to {numbers[-1]}, got {frame}"
        )
    index = int(np.searchsorted(numbers, frame))
    world_from_plane, turn = poses[index], ""
    if angle_deg:
        lateral = float(grid.extent_mm[:, 0].mean()) if lateral_mm is None else lateral_mm
        world_from_plane = turned_frame_plane(poses[index], lateral_line(grid, lateral)[0, 0], angle_deg)
        turn = f", turned by {angle_deg:g}°"
    plane = covering_plane(world_from_plane, grid, poses, modes.reach_mm, pixel_mm)
    return _move_to_modes(modes, plane, f"plane of frame {frame}{turn}", index)


def in_world(modes: SweepModes, grid: ImageGrid, plane: RigidTransform, pixel_mm: float) -> Place:
    """Cut in a plane of the reference's world: x and y of the picture are its own."""
    cut = covering_plane(plane, grid, modes.poses[modes.reference], modes.reach_mm, pixel_mm)
    return _move_to_modes(modes, cut, f"plane from {vector_words(plane.translation)} mm")


def along_curve(
    modes: SweepModes,
    grid: ImageGrid,
    curve_mm: FloatArray,
    pixel_mm: float,
) -> Place:
    """Cut along a curve through points of the reference's world, shape (n, 3), and down into the depth."""
    poses = modes.poses[modes.reference]
    down = _mean_directions(poses)[1]
    # As far along its columns as there is something.
    along = (frame_outlines(grid, poses) - curve_mm[0]) @ down
    sheet = curved_sheet(curve_mm, down, (along.min(), along.max()), pixel_mm)
    # Depth counts from the probe where the curve begins, as the nearest frame has it.
    at = poses.inv().apply(curve_mm[0])
    depth = float(at[np.argmin(np.abs(at[:, 2])), 1])
    sheet = replace(sheet, first_mm=(0.0, sheet.first_mm[1] + depth))
    return _move_to_modes(modes, sheet, f"along a curve through {len(curve_mm)} points")


def _move_to_modes(modes: SweepModes, cut: Cut, words: str, frame: int = 0) -> Place:
    """Take a cut of the reference's world to the poses of every mode, by the frame it hangs on."""
    poses = modes.poses[modes.reference]
    cuts = {mode: cut.moved(path[frame] * poses[frame].inv()) for mode, path in modes.poses.items()}
    plane, along = cut.world_from_picture, "along the curve"
    if plane is not None:
        along = _name(plane.rotation.apply([1.0, 0.0, 0.0]), poses)
    return Place(cuts, (along, _name(cut.down, poses)), words)


def _mean_directions(world_from_image: RigidTransform) -> FloatArray:
    """Mean lateral, axial and elevational direction of frames, shape (3, 3), a unit vector each."""
    axes = world_from_image.rotation.as_matrix().mean(axis=0).T
    return np.asarray(axes / np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-9))


def _name(direction: FloatArray, world_from_image: RigidTransform) -> str:
    """Name of the sweep's direction that an axis follows."""
    cosines = _mean_directions(world_from_image) @ direction
    best = int(np.argmax(np.abs(cosines)))
    if abs(cosines[best]) <= _SAME_DIRECTION:
        return "in the plane"
    return ("lateral", "depth", "along the sweep")[best] + ", backwards" * bool(cosines[best] < 0)
