"""What all viewers of a reconstruction share: its sweep at every mode, images kept in memory, and voxels."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from speckle3d.app.reconstruction.cuts.free_plane import SweepAxes
from speckle3d.app.reconstruction.cuts.newest import Newest
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, Speckle3DError
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.core.sweep import ImageGrid, Sweep
from speckle3d.imaging.images import Images
from speckle3d.imaging.voxels.grid import spacing_within
from speckle3d.imaging.voxels.volume import CompoundedVolume, compound
from speckle3d.scoring.references import find_reference
from speckle3d.scoring.trajectories import poses_of
from speckle3d.study.figures import RANGE_DB
from speckle3d.study.pose_errors import errors_of
from speckle3d.study.posed import PosedSweep
from speckle3d.study.reslices.cuts import OpenedModes, at_modes

KEPT_BYTES = 600_000_000
"""Of images that are kept; those of a longer sweep are made again when they are needed."""
VOXELS_GB = 0.3
"""Of one mode's voxels."""
_LEAST_VOXEL_MM = 0.2
_LEAST_REACH_MM = 0.5


class NotWanted(Exception):
    """Raised inside work that nobody waits for any more."""


class KeptImages:
    """Images that were made once and are kept, the last used ones if they are too many.

    Parameters
    ----------
    images : indexable
        By frame, shape (vector, sample).
    count : int
        How many there are.
    """

    any_thread = True

    def __init__(self, images: Images, count: int, most_bytes: int = KEPT_BYTES) -> None:
        self._images, self._count, self._most = images, count, most_bytes
        self._kept: OrderedDict[int, npt.NDArray[np.generic]] = OrderedDict()
        self._held, self._lock = 0, threading.Lock()

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> npt.NDArray[np.generic]:
        with self._lock:
            if index in self._kept:
                self._kept.move_to_end(index)
                return self._kept[index]
        image = np.asarray(self._images(index) if callable(self._images) else self._images[index])
        with self._lock:
            if index not in self._kept:
                self._kept[index] = image
                self._held += image.nbytes
            while self._held > self._most and len(self._kept) > 1:
                self._held -= self._kept.popitem(last=False)[1].nbytes
        return image


@dataclass(frozen=True)
class Watched:
    """Images that call `look` before each is read; it may raise `NotWanted`."""

    images: KeptImages
    look: Callable[[], None]
    any_thread = True

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: int) -> npt.NDArray[np.generic]:
        self.look()
        return self.images[index]


class Material:
    """A reconstruction with its sweep, for all viewers; what is dear is made when it is first asked for.

    Attributes
    ----------
    reconstruction : Reconstruction
    modes : tuple of str
        Those of the reconstruction and, if the sweep knows the poses of all frames, its truth or tracker.
    grid : ImageGrid
        Of the images that are cut.
    pixel_mm, reach_mm : float
        Of cuts; images reach twice as far as the sweep's longest steps, so that no gaps show.
    """

    def __init__(self, reconstruction: Reconstruction, sweep: Sweep) -> None:
        self.reconstruction, self._sweep = reconstruction, sweep
        first = poses_of(reconstruction, "image")
        self._posed = PosedSweep(sweep, np.arange(len(sweep)), first, "image", reconstruction)
        known = find_reference(sweep)
        self.reference = known if known is not None and known.covered.all() else None
        others = () if self.reference is None else (self.reference.name,)
        self.modes = (*reconstruction.poses, *others)
        self.grid: ImageGrid = reconstruction.grid
        steps = np.linalg.norm(np.diff(first.apply(self.grid.centre_mm), axis=0), axis=1)
        longest = float(np.percentile(steps, 99)) if len(steps) else 0.0
        self.pixel_mm, self.reach_mm = 0.2, max(_LEAST_REACH_MM, round(2.0 * longest, 1))
        self._making = threading.Lock()
        self._made: tuple[KeptImages, ImageGrid] | None = None
        self._voxels: dict[str, CompoundedVolume | str] = {}
        self._opened: dict[tuple[str, str | None], OpenedModes] = {}
        self._axes: dict[str, SweepAxes] = {}
        self._errors: dict[str, FloatArray | None] = {}
        self._asked: dict[str, list[Callable[[str, float], None]]] = {}
        self._maker = Newest(self._make_voxels)

    def opened(self, mode: str, other: str | None = None) -> OpenedModes:
        """The sweep at a mode, which is the reference, and perhaps at another."""
        if (mode, other) not in self._opened:
            self._opened[mode, other] = at_modes(self._posed, [mode, *([other] if other else [])], mode)
        return self._opened[mode, other]

    def axes(self, mode: str) -> SweepAxes:
        """Where the sweep is at a mode."""
        if mode not in self._axes:
            self._axes[mode] = SweepAxes.of(self.grid, self.opened(mode).poses[mode])
        return self._axes[mode]

    def errors(self, mode: str) -> FloatArray | None:
        """Covariance of every frame's pose that a mode claims, shape (n, 6, 6); None where nothing is known.

        Of (x, y, z, tilt, yaw, roll) about the image's centre along the mode's first frame, mm and rad.
        """
        if mode not in self._errors:
            try:
                self._errors[mode] = errors_of(self.reconstruction, mode).covariance()
            except (InvalidInputError, InsufficientDataError):
                self._errors[mode] = None
        return self._errors[mode]

    def images(self, look: Callable[[], None] = lambda: None) -> tuple[Images, ImageGrid]:
        """Images to cut, log-compressed, and their grid; `look` is called before each is read."""
        with self._making:
            if self._made is None:
                images, grid = self._posed.images(RANGE_DB)
                self._made = KeptImages(images, len(self._sweep)), grid
        return Watched(self._made[0], look), self._made[1]

    def voxels(self, mode: str) -> CompoundedVolume | None:
        """Voxels of a mode, if they are made.

        Raises
        ------
        Speckle3DError
            If they cannot be.
        """
        found = self._voxels.get(mode)
        if isinstance(found, str):
            raise Speckle3DError(found)
        return found

    def ask_for_voxels(self, mode: str, told: Callable[[str, float], None]) -> None:
        """Have the voxels of a mode made in the background.

        Parameters
        ----------
        told : callable
            Called from another thread with the mode and the share that is done, 1 at last.
        """
        with self._making:
            is_made = mode in self._voxels
            if not is_made:
                self._asked.setdefault(mode, []).append(told)
        if is_made:
            told(mode, 1.0)
        else:
            self._maker.ask(None)

    def _make_voxels(self, _: None) -> None:
        while self._asked:
            mode = next(iter(self._asked))
            found: CompoundedVolume | str
            try:
                found = self._compounded(mode)
            except Speckle3DError as error:
                found = str(error)
            with self._making:
                self._voxels[mode] = found
                waiting = self._asked.pop(mode)
            for told in waiting:
                told(mode, 1.0)

    def _compounded(self, mode: str) -> CompoundedVolume:
        read = 0

        def look() -> None:
            nonlocal read
            read += 1
            if read % 8 == 0:
                self._tell(mode, min(0.95 * read / len(self._sweep), 0.95))

        poses, axes = self.opened(mode).poses[mode], self.axes(mode).world_from_axes
        images, grid = self.images(look)
        voxel_mm = max(_LEAST_VOXEL_MM, spacing_within(grid, poses, VOXELS_GB, axes))
        return compound(images, grid, poses, voxel_mm, voxel_type="uint8", world_from_axes=axes)

    def _tell(self, mode: str, share: float) -> None:
        for told in list(self._asked.get(mode, ())):
            told(mode, share)
