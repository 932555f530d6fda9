"""Grey levels of amplitudes and of decibels, made frame by frame on the way out of the file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.io.lazy import HDF5Slices, Layout, Slices

ENVELOPE_RANGE_DB = 80.0
"""Of grey levels made here unless another is given: 0.31 dB a level, while speckle itself spreads by 5.6
dB."""

_NOTHING_DB = -1e6


@dataclass(frozen=True)
class Levels:
    """Turns decibels, or an echo's amplitude, into grey levels, 255 at `top`, 0 that range below."""

    layout: Layout
    decibels: bool
    top: float
    dynamic_range_db: float

    def __call__(self, slices: Slices) -> npt.NDArray[Any]:
        """Make a frame."""
        values = self.layout.of(slices[0]).astype(np.float64)
        if self.decibels:
            below = values - self.top
        else:
            with np.errstate(divide="ignore", invalid="ignore"):
                below = 20.0 * np.log10(values / self.top)
        if np.isnan(below).any():
            raise InvalidInputError("expected echoes' amplitudes, got NaN or a negative one")
        levels = 255.0 * (1.0 + below / self.dynamic_range_db)
        return np.rint(np.clip(levels, 0.0, 255.0)).astype(np.uint8)


@dataclass(frozen=True)
class _Plain:
    """Turns numbers as they are, but for the logarithm of no echo at all."""

    layout: Layout

    def __call__(self, slices: Slices) -> npt.NDArray[Any]:
        values = self.layout.of(slices[0]).astype(np.float64)
        return np.where(np.isneginf(values), _NOTHING_DB, values)


def grey_frames(
    path: PathLike,
    names: Sequence[str],
    axis: int | None,
    layout: Layout,
    shape: tuple[int, int, int],
    decibels: bool,
    dynamic_range_db: float | None,
) -> tuple[HDF5Slices, float, float]:
    """Frames of grey levels; all frames are read once to find the strongest echo, which becomes 255.

    Returns
    -------
    frames : HDF5Slices
    top, dynamic_range_db : float
        What 255 stands for, and how far below it 0 is.

    Raises
    ------
    InvalidInputError
        If there is no echo at all.
    """
    plain = HDF5Slices(path, names, axis, _Plain(layout), shape, np.float64)
    top = max(float(plain[i].max()) for i in range(shape[0]))
    plain.close()
    if not (decibels or top > 0):
        raise InvalidInputError(f"{path}: expected echoes, got amplitudes up to {top:g}")
    span = dynamic_range_db or ENVELOPE_RANGE_DB
    return HDF5Slices(path, names, axis, Levels(layout, decibels, top, span), shape, np.uint8), top, span
