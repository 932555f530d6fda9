"""A medium of scatterers that a test lists one by one."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PointMedium:
    """Scatterers at positions, shape (n, 3), mm, of strengths, shape (n,)."""

    position_mm: np.ndarray
    strength: np.ndarray
    attenuation_db_cm_mhz: float = 0.0

    def scatterers(self, medium_from_image, box):
        return [(self.position_mm, self.strength)]
