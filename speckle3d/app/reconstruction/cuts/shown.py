"""What a viewer shows: modes, where the cuts are, and the cuts themselves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from speckle3d.app.reconstruction.cuts.free_plane import FreePlane, SweepAxes
from speckle3d.app.reconstruction.cuts.material import Material
from speckle3d.imaging.cuts.reslice import reslice_volume
from speckle3d.imaging.voxels.volume import CompoundedVolume
from speckle3d.study.figures import RANGE_DB
from speckle3d.study.reslices.cuts import CutPicture, DrawnCut, OpenedModes
from speckle3d.study.reslices.places import Place

Name = Literal["along", "frame", "depth", "free"]
NAMES: tuple[Name, ...] = ("along", "frame", "depth", "free")
"""Cuts: along the sweep, in a frame's plane, parallel to the skin, and the one that is dragged."""

LEVELS_DB = (-RANGE_DB, 0.0)
"""Black and white."""


@dataclass(frozen=True)
class Shown:
    """Modes and places of the cuts.

    Attributes
    ----------
    mode : str
        The one whose world places and points are in.
    other : str or None
        A second mode.
    is_difference : bool
        Lay the second mode over the first, in place of beside it.
    frame : int
    lateral_mm, depth_mm : float
        In the images.
    plane : FreePlane
    """

    mode: str
    other: str | None = None
    is_difference: bool = False
    frame: int = 0
    lateral_mm: float = 0.0
    depth_mm: float = 0.0
    plane: FreePlane = field(default_factory=FreePlane)

    @property
    def modes(self) -> tuple[str, ...]:
        """The mode and, if there is one, the other."""
        return (self.mode, self.other) if self.other else (self.mode,)

    def place(self, name: Name, axes: SweepAxes, material: Material) -> Place:
        """Where a cut is."""
        pixel_mm, reach_mm = material.pixel_mm, material.reach_mm
        if name == "along":
            return Place(lateral_mm=self.lateral_mm, pixel_mm=pixel_mm, reach_mm=reach_mm)
        if name == "frame":
            return Place(frame=self.frame, pixel_mm=pixel_mm, reach_mm=reach_mm)
        if name == "depth":
            return Place(depth_mm=self.depth_mm, pixel_mm=pixel_mm, reach_mm=reach_mm)
        return axes.place(self.plane, pixel_mm, reach_mm)

    def key(self, name: Name) -> tuple[object, ...]:
        """What a cut depends on: the same key, the same cut."""
        where = {
            "along": self.lateral_mm, "frame": self.frame, "depth": self.depth_mm, "free": self.plane,
        }[name]  # fmt: skip
        return (self.mode, self.other, where)


def cut_of_voxels(
    opened: OpenedModes, place: Place, material: Material, voxels: Mapping[str, CompoundedVolume]
) -> CutPicture:
    """Cut the voxels of every mode, at once; see `speckle3d.study.reslices.cuts.cut_posed` for frames.

    Raises
    ------
    InvalidInputError
        If the place does not meet the sweep.
    """
    grid = material.grid
    placed = place.cuts(opened.poses, grid, opened.reference)
    step_db = np.float32(RANGE_DB / 255)
    cuts = {
        mode: DrawnCut((reslice_volume(voxels[mode], cut, voxels[mode].state) - 255) * step_db, cut)
        for mode, cut in placed.items()
    }
    shown, there = placed[opened.reference], opened.poses[opened.reference]
    return CutPicture(cuts, place.axes(shown, there), place.words(grid), levels=LEVELS_DB)
