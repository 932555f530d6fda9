"""Grey images of a sweep with the poses of a mode, as a sequence that 3D Slicer plays in its world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ByteArray, FloatArray
from speckle3d.core.files import PathLike
from speckle3d.core.sweep import BModeSettings, ImageGrid, Sweep
from speckle3d.imaging.images import Images
from speckle3d.io.plus.transforms import image_matrix
from speckle3d.io.plus.write import write_sequence
from speckle3d.study.posed import PosedSweep

POSES = "ImageToWorld"
"""Name of the frames' poses in a sequence: of pixels, to mm in 3D Slicer's world."""

_RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class _Bytes:
    """Grey images, 0 to 255, rounded as they are asked for."""

    images: Images
    shape: tuple[int, int, int]

    @property
    def dtype(self) -> np.dtype[np.uint8]:
        return np.dtype(np.uint8)

    def __getitem__(self, index: int) -> ByteArray:
        image: npt.NDArray[Any] = self.images(index) if callable(self.images) else self.images[index]
        return np.asarray(np.clip(np.rint(image), 0, 255), dtype=np.uint8)


def write_posed_sequence(
    path: PathLike,
    posed: PosedSweep,
    dynamic_range_db: float = 60.0,
    progress: Callable[[int, int], None] | None = None,
    compressed: bool = True,
) -> None:
    """Write a sweep's grey images with their poses as a sequence; the file appears whole or not at all.

    Poses are transforms ``ImageToWorld`` of pixels, as 3D Slicer takes them: unlike in other files of this
    package, axes lead right, anterior and superior, for such a file cannot say where its axes lead.

    Parameters
    ----------
    path : path
        As of `write_sequence`: .seq.nrrd opens in 3D Slicer, .seq.mha with its extension SlicerIGSIO.
    posed : PosedSweep
    dynamic_range_db : float
        Range of the log-compressed grey levels.
    progress : callable, optional
        Called with the number of images written and their total.
    compressed : bool
        Whether pixels are packed with deflate.

    Raises
    ------
    InvalidInputError
        If the suffix is another.
    FileError
        If the file cannot be written.
    """
    images, grid = posed.images(dynamic_range_db)
    count = len(posed.frames)
    frames = _Bytes(images, (count, grid.vectors, grid.samples))
    times = posed.sweep.frame_time_s[posed.frames]
    signal = BModeSettings(dynamic_range_db)
    sweep = Sweep(frames, grid, signal, times, name=posed.sweep.name, probe=posed.sweep.probe)
    write_sequence(path, sweep, progress, compressed, {POSES: slicer_poses(posed, grid)})


def slicer_poses(posed: PosedSweep, grid: ImageGrid) -> FloatArray:
    """Transforms of pixels (column, row, 0, 1) to mm in 3D Slicer's world, shape (n, 4, 4)."""
    sizes = grid.vector_pitch_mm, grid.sample_spacing_mm, grid.first_sample_depth_mm
    lps_from_pixels = np.stack([image_matrix(pose, *sizes) for pose in posed.world_from_image])
    return np.asarray(_RAS_FROM_LPS @ lps_from_pixels)
