"""Growing volume of a live sweep, compounded from small images at the current poses."""

import threading

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import Float16Array, Float32Array, IntArray
from speckle3d.core.grid import ImageGrid
from speckle3d.correction.crossing.stack import ImageStack
from speckle3d.imaging.voxels.grid import spacing_within
from speckle3d.imaging.voxels.volume import CompoundedVolume, compound

MOST_IMAGES = 1200
"""Images that are kept, every second one being dropped when there are more: some 30 MB."""
VOXELS_GB = 0.004
"""Of a volume that is sent about once a second."""
RANGE_DB = 60.0
_BRIGHT_PERCENTILE = 99.9


class GrowingVolume:
    """Keeps small images of a sweep's frames, and makes volumes of them.

    An image sink as of `speckle3d.track`: pass `keep` as ``images``.

    Parameters
    ----------
    grid : ImageGrid
        Of the intensity images.

    Attributes
    ----------
    grid : ImageGrid
        Of the small images.
    """

    def __init__(self, grid: ImageGrid) -> None:
        self._pooled = ImageStack(grid)
        self.grid = self._pooled.grid
        self._images: dict[int, Float16Array] = {}
        self._every = 1
        self._latest: Float16Array | None = None
        self._lock = threading.Lock()

    def keep(self, index: int, intensity: Float32Array) -> None:
        """Keep a frame's image, unless those of its neighbours are enough."""
        self._pooled.keep(0, intensity)
        self._latest = self._pooled.images(1)[0].astype(np.float16)
        if index % self._every:
            return
        with self._lock:
            self._images[index] = self._latest
            if len(self._images) > MOST_IMAGES:
                self._every *= 2
                self._images = {k: image for k, image in self._images.items() if k % self._every == 0}

    def latest(self) -> Float32Array | None:
        """Grey levels of the latest frame's small image, shape (vector, sample); None before the first."""
        return None if self._latest is None else grey_levels(self._latest[None])[0]

    def images(self) -> tuple[IntArray, Float16Array]:
        """Numbers of the frames whose images are kept, and these, dB, shape (n, vector, sample)."""
        with self._lock:
            numbers = np.array(sorted(self._images), dtype=np.int64)
            return numbers, np.stack([self._images[k] for k in numbers.tolist()])

    def compound(self, poses: RigidTransform) -> CompoundedVolume:
        """Make a volume of grey levels, as coarse as its size asks for.

        Parameters
        ----------
        poses : RigidTransform
            ``world_from_image`` of all frames that were kept, and perhaps others.
        """
        numbers, images = self.images()
        has_pose = numbers < len(poses)
        at = poses[numbers[has_pose]]
        voxel_mm = max(spacing_within(self.grid, at, VOXELS_GB), self.grid.vector_pitch_mm)
        return compound(grey_levels(images[has_pose]), self.grid, at, voxel_mm, voxel_type="uint8")


def grey_levels(images: Float16Array) -> Float32Array:
    """Grey levels of images in dB, those of the last one deciding what is white; NaN stays."""
    bright = np.float32(np.nanpercentile(images[-1].astype(np.float32), _BRIGHT_PERCENTILE))
    levels = 1.0 + (images.astype(np.float32) - bright) / np.float32(RANGE_DB)
    return np.asarray(np.float32(255.0) * np.clip(levels, 0.0, 1.0))
