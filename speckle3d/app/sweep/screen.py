"""Images of a sweep as a screen shows them: B-mode made as frames are asked for."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ByteArray, Float32Array
from speckle3d.core.sweep import BModeSettings, ImageGrid, Sweep
from speckle3d.imaging.voxels.settings import Levels
from speckle3d.matching.intensity import IntensitySettings
from speckle3d.study.images import GreyImages

MOST_ROWS = 640
"""Rows that are sent to the browser: more than a screen shows, and a third of what echoes are sampled at."""
RANGES_DB = (30, 90)
"""Dynamic ranges that can be chosen."""
USUAL_DB = 60


class ScreenImages:
    """Grey images of a sweep's frames, 0 to 255, with their rows pooled to what a screen can show.

    Parameters
    ----------
    sweep : Sweep
    settings : IntensitySettings, optional
        How echoes become intensity.
    """

    def __init__(self, sweep: Sweep, settings: IntensitySettings | None = None) -> None:
        self._sweep, self._settings = sweep, settings
        # The brightest echo of a range is looked for once.
        self._made = lru_cache(maxsize=8)(self._make)

    @property
    def of_echoes(self) -> bool:
        """Whether a dynamic range can be chosen: stored B-mode is compressed already."""
        return not isinstance(self._sweep.signal, BModeSettings)

    def meaning(self, range_db: int = USUAL_DB) -> str:
        """What the grey levels are, in words."""
        return self._made(range_db).meaning

    def grid(self) -> ImageGrid:
        """Where the samples lie that rows are pooled from."""
        return self._made(USUAL_DB).grid

    def extent_mm(self) -> tuple[float, float, float, float]:
        """Left, top, width and height of the picture, out to the edges of its pixels."""
        grid = self.grid()
        pool = self._pool(grid)
        rows = grid.samples // pool * pool
        left, top = grid.vector_pitch_mm / 2, grid.sample_spacing_mm / 2
        return (
            -left,
            grid.first_sample_depth_mm - top,
            grid.vectors * grid.vector_pitch_mm,
            rows * grid.sample_spacing_mm,
        )

    def image(self, frame: int, range_db: int = USUAL_DB) -> ByteArray:
        """Picture of a frame, shape (row, column)."""
        images = self._made(range_db)
        grey = images[frame]
        if isinstance(self._sweep.signal, BModeSettings) and self._sweep.signal.full_scale != 255.0:
            grey = grey * np.float32(255.0 / self._sweep.signal.full_scale)
        return np.ascontiguousarray(_pooled(grey, self._pool(images.grid)).T)

    def _make(self, range_db: int) -> GreyImages:
        levels: Levels = "log" if self.of_echoes else "stored"
        return GreyImages(self._sweep, float(range_db), settings=self._settings, levels=levels)

    def _pool(self, grid: ImageGrid) -> int:
        return max(1, -(-grid.samples // MOST_ROWS))


def _pooled(grey: npt.NDArray[np.number], pool: int) -> ByteArray:
    """Means of `pool` samples each, shape (vector, row)."""
    if pool == 1:
        return np.asarray(np.clip(grey, 0, 255), dtype=np.uint8)
    rows = grey.shape[1] // pool
    parts: Float32Array = grey[:, : rows * pool].astype(np.float32).reshape(grey.shape[0], rows, pool)
    # NumPy's mean takes more than twice as long over so short an axis.
    return np.asarray(np.clip(np.einsum("vrp->vr", parts) / pool, 0, 255), dtype=np.uint8)
