"""The correlations of all matched frame pairs of a sweep: all that later stages need of the images."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray
from speckle3d.matching.inplane import InPlaneMotion


class Matched(Protocol):
    """What two frames have in common: the correlation of each patch, shape (p,), and in-plane motion."""

    @property
    def correlation(self) -> FloatArray: ...  # noqa: D102

    @property
    def motion(self) -> InPlaneMotion: ...  # noqa: D102


class CorrelationTable:
    """Pairs in the order of their second frames; about one kilobyte each, a frame being a megabyte."""

    def __init__(self, patches: int) -> None:
        self._patches = patches
        self._frames: list[tuple[int, int]] = []
        self._correlation: list[Float32Array] = []
        self._motion: list[InPlaneMotion] = []

    def __len__(self) -> int:
        return len(self._frames)

    def append(self, first: int, second: int, match: Matched) -> None:
        """Add one pair."""
        self._frames.append((first, second))
        self._correlation.append(match.correlation.astype(np.float32))
        self._motion.append(match.motion)

    @property
    def first(self) -> IntArray:
        """First frame of each pair, shape (e,)."""
        return self._column(0)

    @property
    def second(self) -> IntArray:
        """Second frame of each pair, shape (e,)."""
        return self._column(1)

    @property
    def correlation(self) -> Float32Array:
        """Correlation of each patch, shape (e, p)."""
        return np.array(self._correlation, dtype=np.float32).reshape(len(self), self._patches)

    def motion(self, row: int) -> InPlaneMotion:
        """In-plane motion of one pair."""
        return self._motion[row]

    def _column(self, k: int) -> IntArray:
        return np.array(self._frames, dtype=np.int64).reshape(-1, 2)[:, k]
