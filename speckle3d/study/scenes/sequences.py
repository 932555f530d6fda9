"""Grey images of a sweep with the poses of a mode, as a sequence that 3D Slicer plays in its world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ByteArray, FloatArray
from speckle3d.core.files import PathLike
from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.imaging.images import Images
from speckle3d.io.plus.transforms import image_matrix
from speckle3d.io.plus.write import write_sequence, write_transforms
from speckle3d.study.posed import USUAL_RANGE_DB, PosedSweep

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


@dataclass(frozen=True)
class PosedSequence:
    """Grey images of the frames that have a pose, and where their pixels are in 3D Slicer's world.

    Attributes
    ----------
    sweep : Sweep
        Of B-mode, read one at a time.
    world_from_pixels : ndarray, shape (n, 4, 4)
        From pixels (column, row, 0, 1) to mm. Unlike in other files of this package, axes lead right,
        anterior and superior, as Slicer takes them: a sequence cannot say where its axes lead.
    """

    sweep: Sweep
    world_from_pixels: FloatArray

    @classmethod
    def of(cls, posed: PosedSweep, dynamic_range_db: float = USUAL_RANGE_DB) -> PosedSequence:
        """Take a posed sweep's images, B-mode as stored and echoes log-compressed.

        Parameters
        ----------
        dynamic_range_db : float
            Range of the log-compressed grey levels.
        """
        source, _ = posed.source(None, dynamic_range_db)
        grid, own = source.grid, posed.sweep.signal
        signal = own if isinstance(own, BModeSettings) else BModeSettings(dynamic_range_db)
        frames = _Bytes(source.images, (len(source), grid.vectors, grid.samples))
        times = posed.sweep.frame_time_s[posed.frames]
        sweep = Sweep(frames, grid, signal, times, name=posed.sweep.name, probe=posed.sweep.probe)
        sizes = grid.vector_pitch_mm, grid.sample_spacing_mm, grid.first_sample_depth_mm, grid.skew_rad
        lps_from_pixels = np.stack([image_matrix(pose, *sizes) for pose in posed.world_from_image])
        return cls(sweep, np.asarray(_RAS_FROM_LPS @ lps_from_pixels))

    def write(
        self, path: PathLike, progress: Callable[[int, int], None] | None = None, compressed: bool = True
    ) -> None:
        """Write images with their poses as ``ImageToWorld``; the file appears whole or not at all.

        Parameters
        ----------
        path : path
            As of `write_sequence`: .seq.nrrd opens in 3D Slicer, .seq.mha with its extension SlicerIGSIO.
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
        write_sequence(path, self.sweep, progress, compressed, {POSES: self.world_from_pixels})

    def write_poses(self, path: PathLike) -> None:
        """Write the poses alone, as a sequence of transforms (.seq.mha)."""
        write_transforms(path, self.sweep.frame_time_s, {POSES: self.world_from_pixels})
