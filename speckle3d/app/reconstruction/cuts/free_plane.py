"""The plane that is dragged: three numbers, and how they change with its line in another cut."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.sweep import ImageGrid
from speckle3d.imaging.axes import sweep_axes
from speckle3d.imaging.cuts.planes import ReslicePlane
from speckle3d.study.reslices.places import Place

_DIGITS = 6
"""Of the numbers that say where the plane is: a command that repeats them cuts the same plane."""
_LEAST_SINE = 0.03
"""Of the angle at which two planes are said to cross: two degrees."""


@dataclass(frozen=True)
class FreePlane:
    """A plane through a sweep by its shift along its normal, and two angles.

    Attributes
    ----------
    shift_mm : float
        Along the plane's normal from the sweep's centre.
    turn_deg : float
        About the sweep's mean depth line: 0 is across the sweep, as the frames are; 90 along it.
    tilt_deg : float
        Then about the plane's own horizontal: 90 is parallel to the skin.
    """

    shift_mm: float = 0.0
    turn_deg: float = 0.0
    tilt_deg: float = 0.0


@dataclass(frozen=True)
class SweepAxes:
    """Where a sweep is: its centre and its mean lateral, axial and elevational axes.

    Attributes
    ----------
    centre_mm : ndarray, shape (3,)
        Of the middle frame's image, in the world.
    world_from_axes : Rotation
    """

    centre_mm: FloatArray
    world_from_axes: Rotation

    @classmethod
    def of(cls, grid: ImageGrid, world_from_image: RigidTransform) -> SweepAxes:
        """Axes of the images at some poses."""
        middle = world_from_image[len(world_from_image) // 2].apply(grid.centre_mm)
        return cls(np.asarray(middle), sweep_axes(world_from_image))

    def axes_of(self, plane: FreePlane) -> Rotation:
        """World from the plane's right, down and normal."""
        turned = Rotation.from_euler("YX", [-plane.turn_deg, plane.tilt_deg], degrees=True)
        return self.world_from_axes * turned

    def place(self, plane: FreePlane, pixel_mm: float, reach_mm: float) -> Place:
        """Where to cut, in numbers that a command can repeat."""
        right, down, normal = self.axes_of(plane).as_matrix().T
        origin = self.centre_mm + plane.shift_mm * normal
        origin, right, down = (np.round(each, _DIGITS) + 0.0 for each in (origin, right, down))
        return Place(origin_mm=origin, right=right, down=down, pixel_mm=pixel_mm, reach_mm=reach_mm)

    def line_in(self, plane: FreePlane, cut: ReslicePlane) -> tuple[FloatArray, float] | None:
        """Line in which the plane crosses a cut: normal and offset by the cut's axes, mm.

        Returns
        -------
        (ndarray, shape (2,), float) or None
            A point p of the cut is on the line if ``normal @ p == offset``; None where both are parallel.
        """
        normal = self.axes_of(plane).as_matrix()[:, 2]
        right, down = cut.world_from_plane.rotation.as_matrix().T[:2]
        across = np.array([normal @ right, normal @ down])
        size = float(np.linalg.norm(across))
        if size < _LEAST_SINE:
            return None
        offset = plane.shift_mm - normal @ (cut.world_from_mm(0.0, 0.0) - self.centre_mm)
        return across / size, float(offset) / size

    def moved(self, plane: FreePlane, cut: ReslicePlane, old_mm: FloatArray, new_mm: FloatArray) -> FreePlane:
        """The plane after a point of its line in a cut was moved, by the cut's axes."""
        step = cut.world_from_mm(*new_mm) - cut.world_from_mm(*old_mm)
        normal = self.axes_of(plane).as_matrix()[:, 2]
        return FreePlane(plane.shift_mm + float(step @ normal), plane.turn_deg, plane.tilt_deg)

    def turned(
        self, plane: FreePlane, cut: ReslicePlane, about_mm: FloatArray, angle_rad: float
    ) -> FreePlane:
        """The plane after its line in a cut was turned about one of its points, from x towards y."""
        about_normal = cut.world_from_plane.rotation.apply([0.0, 0.0, 1.0])
        turn = Rotation.from_rotvec(angle_rad * about_normal)
        normal = turn.apply(self.axes_of(plane).as_matrix()[:, 2])
        shift = float(normal @ (cut.world_from_mm(*about_mm) - self.centre_mm))
        x, y, z = self.world_from_axes.inv().apply(normal)
        tilt = np.arcsin(np.clip(-y, -1.0, 1.0))
        # Parallel to the skin every turn is the same plane: it stays.
        turned = np.arctan2(-x, z) if np.hypot(x, z) > 1e-9 else np.deg2rad(plane.turn_deg)
        return FreePlane(shift, float(np.rad2deg(turned)), float(np.rad2deg(tilt)))
