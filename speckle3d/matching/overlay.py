"""What stands still in the images while the probe moves: text, a ruler, ringing without contact.

Its patches tell nothing of the motion. In the others' local mean it would be a pattern that stays, as if the
probe had moved less.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import BoolArray, Complex64Array

STANDING = 0.5
"""Share of a sample's power that is in the mean of the frames' echoes, from which it stands still. Of n
independent frames of speckle (1 - 0.5)^(n - 1) of the samples have it by chance."""


class Overlay:
    """Samples that no frame changes, of some frames that are far apart."""

    def __init__(self) -> None:
        self._count = 0
        self._extremes: tuple[npt.NDArray[Any], npt.NDArray[Any]] | None = None
        self._sums: tuple[npt.NDArray[Any], npt.NDArray[Any]] | None = None

    def keep(self, samples: npt.NDArray[Any], analytic: Complex64Array | None, is_bmode: bool) -> None:
        """Look at one frame.

        Parameters
        ----------
        samples : ndarray, shape (vector, sample)
            As read; grey levels are compared.
        analytic : ndarray, shape (vector, grid.samples), optional
            Of echoes with phase.
        """
        self._count += 1
        if is_bmode:
            darkest, brightest = self._extremes or (samples, samples)
            self._extremes = np.minimum(darkest, samples), np.maximum(brightest, samples)
        elif analytic is not None:
            power = analytic.real**2 + analytic.imag**2
            total, powers = self._sums or (0.0, 0.0)
            self._sums = total + analytic, powers + power

    @property
    def samples(self) -> BoolArray | None:
        """Which samples of the intensity images stand still; None where it is not known."""
        if self._extremes is not None:
            darkest, brightest = self._extremes
            return np.asarray((darkest == brightest) & (darkest > 0))
        if self._sums is not None:
            total, powers = self._sums
            return np.asarray(np.abs(total) ** 2 > STANDING * self._count * powers)
        return None
