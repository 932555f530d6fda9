"""Grey images of a sweep with the poses of a mode, as a sequence that 3D Slicer plays in its world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ByteArray, FloatArray
from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.imaging.images import PosedImages
from speckle3d.study.posed import USUAL_RANGE_DB, PosedSweep

_RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class _Bytes:
    """Grey images, 0 to 255, rounded as they are asked for."""

    source: PosedImages
    dtype = np.dtype(np.uint8)

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.source), self.source.grid.vectors, self.source.grid.samples

    def __getitem__(self, index: int) -> ByteArray:
        image: npt.NDArray[Any] = self.source.read(index)
        # Outside a fan there is nothing.
        return np.asarray(np.clip(np.rint(np.nan_to_num(image)), 0, 255), dtype=np.uint8)


def slicer_sequence(
    posed: PosedSweep, dynamic_range_db: float = USUAL_RANGE_DB
) -> tuple[Sweep, dict[str, FloatArray]]:
    """Take a posed sweep's images, B-mode as stored and echoes log-compressed, and where their pixels are.

    Parameters
    ----------
    posed : PosedSweep
    dynamic_range_db : float
        Range of the log-compressed grey levels.

    Returns
    -------
    sweep : Sweep
        Of B-mode, read one at a time.
    poses : dict of str to ndarray, shape (n, 4, 4)
        ``ImageToWorld``, for `write_sequence`: from pixels (column, row, 0, 1) to mm. Unlike in other files
        of this package, axes lead right, anterior and superior, as Slicer takes them: a sequence cannot say
        where its axes lead.
    """
    source, _ = posed.source(None, dynamic_range_db)
    grid, signal = source.grid, posed.sweep.signal
    signal = signal if isinstance(signal, BModeSettings) else BModeSettings(dynamic_range_db)
    times, name = posed.sweep.frame_time_s[posed.frames], posed.sweep.name
    sweep = Sweep(_Bytes(source), grid, signal, times, name=name, probe=posed.sweep.probe)
    thick_mm = (grid.vector_pitch_mm + grid.sample_spacing_mm) / 2
    image_from_pixels = np.insert(grid.image_from_sample, 2, [0.0, 0.0, thick_mm, 0.0], axis=1)
    lps_from_pixels = posed.world_from_image.as_matrix() @ image_from_pixels
    return sweep, {"ImageToWorld": np.asarray(_RAS_FROM_LPS @ lps_from_pixels)}
