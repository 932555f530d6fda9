"""What stands still in the images while the probe moves: text, a ruler, ringing without contact.

Its patches tell nothing of the motion. In the others' local mean it would be a pattern that stays, as if the
probe had moved less.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import BoolArray
from speckle3d.matching.intensity import Echo

STANDING = 0.5
"""Share of a sample's power that is in the mean of the frames' echoes, from which it stands still. Of n
independent frames of speckle (1 - 0.5)^(n - 1) of the samples have it by chance."""


class Overlay:
    """Samples that no frame changes, of some frames that are far apart.

    Attributes
    ----------
    count : int
        Of frames that were finite.
    power : ndarray, shape (vector, grid.samples)
        Sum of the frames' intensities.
    """

    def __init__(self) -> None:
        self.count = 0
        self.power: Any = np.float32(0.0)
        self._total: Any = np.complex64(0.0)
        self._extremes: tuple[npt.NDArray[Any], npt.NDArray[Any]] | None = None

    def keep(self, samples: npt.NDArray[Any], echo: Echo) -> None:
        """Look at one frame, as read and its echo: where there is no phase, grey levels are compared."""
        if not np.isfinite(echo.intensity.sum()):
            return
        self.count += 1
        self.power = self.power + echo.intensity
        if echo.analytic is not None:
            self._total = self._total + echo.analytic
        elif samples.shape == echo.intensity.shape:
            darkest, brightest = self._extremes or (samples, samples)
            self._extremes = np.minimum(darkest, samples), np.maximum(brightest, samples)

    @property
    def standing(self) -> BoolArray:
        """Which samples of the intensity images stand still, shape (vector, grid.samples)."""
        if self._extremes is not None:
            darkest, brightest = self._extremes
            return np.asarray((darkest == brightest) & (darkest > 0))
        return np.asarray(np.abs(self._total) ** 2 > STANDING * self.count * self.power)
