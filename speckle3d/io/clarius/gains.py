"""Gain that differs between frames, as factors of their samples; made when a frame is read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import ComplexArray, FloatArray
from speckle3d.io.clarius.sidecars import Curve

_SAME_DB = 0.005
"""Gains are written to 0.01 dB."""


@dataclass(frozen=True)
class GainFactors:
    """The first frame's gain over each one's; as long as a recording, without an array for each frame.

    Attributes
    ----------
    depth_mm : ndarray, shape (sample,)
    curves : sequence of Curve
        Of each frame; equal ones are one object.
    turns : ndarray, shape (1, sample), optional
        Other factors, the same in all frames.
    """

    depth_mm: FloatArray
    curves: Sequence[Curve]
    turns: ComplexArray | None = None

    def __len__(self) -> int:
        return len(self.curves)

    def __getitem__(self, index: int) -> FloatArray | ComplexArray:
        apart_db = self._gain_db(self.curves[index]) - self._gain_db(self.curves[0])
        ratio = np.asarray(10.0 ** (-apart_db / 20.0))
        return ratio if self.turns is None else ratio * self.turns[0]

    @property
    def differ(self) -> bool:
        """Whether any frame has another gain than the first, by more than they are written to."""
        first_db = self._gain_db(self.curves[0])
        return any(np.abs(self._gain_db(each) - first_db).max() >= _SAME_DB for each in set(self.curves))

    def _gain_db(self, curve: Curve) -> FloatArray:
        return np.asarray(np.interp(self.depth_mm, *np.array(curve).T))
