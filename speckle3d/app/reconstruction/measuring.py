"""Points that are clicked on, and what is measured between them, as `speckle3d measure` has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from speckle3d.app.reconstruction.commands import DIGITS
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, Speckle3DError
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.imaging.measures.belonging import require_inside
from speckle3d.scoring.trajectories import poses_of
from speckle3d.study.pose_errors import PICKED, caution, measure


@dataclass(frozen=True)
class Picked:
    """Points of one mode's world, in the order of picking.

    Attributes
    ----------
    mode : str
    points_mm : tuple of ndarray, shape (3,)
        Rounded as commands write them.
    """

    mode: str
    points_mm: tuple[FloatArray, ...] = ()

    def with_point(self, point_mm: FloatArray, reconstruction: Reconstruction) -> Picked:
        """These points and another.

        Raises
        ------
        InvalidInputError
            If it is not in the sweep, or the mode is not one of the reconstruction.
        """
        if self.mode not in reconstruction.poses:
            raise InvalidInputError(f"expected a mode of the reconstruction to measure in, got {self.mode}")
        point = np.round(np.asarray(point_mm, dtype=float), DIGITS) + 0.0
        require_inside(point[None], reconstruction.grid, poses_of(reconstruction, self.mode))
        return Picked(self.mode, (*self.points_mm, point))

    def measured(self, reconstruction: Reconstruction) -> list[str]:
        """Distances, length and angles in words, or what is missing."""
        if len(self.points_mm) < 2:
            return []
        try:
            found = measure(reconstruction, np.array(self.points_mm), self.mode)
        except Speckle3DError as error:
            return [str(error)]
        words = caution(reconstruction, self.mode)
        picked_mm = PICKED * reconstruction.grid.vector_pitch_mm
        told = f"mode {self.mode}; points picked to {picked_mm:.2g} mm per axis; 95 % in brackets"
        return [*(each.line for each in found), told, *([words] if words else [])]
