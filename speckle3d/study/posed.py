"""A sweep with the poses of its frames: by a reconstruction's mode, or by what the recording itself says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.core.sweep import ImageGrid, Sweep
from speckle3d.imaging.images import ChosenImages, Images
from speckle3d.io.load import kind_of, load_sweep
from speckle3d.io.reconstructions import FORMAT
from speckle3d.scoring.references import REFERENCES, find_reference
from speckle3d.scoring.trajectories import poses_of
from speckle3d.study.images import grey_images, open_reconstruction


@dataclass(frozen=True)
class PosedSweep:
    """A sweep, and where its frames are.

    Attributes
    ----------
    sweep : Sweep
    frames : ndarray of int, shape (k,)
        Frames that have a pose.
    world_from_image : RigidTransform, length k
    mode : str
        Where poses are from: a mode of the reconstruction, "tracker" or "truth".
    reconstruction : Reconstruction or None
        None where the recording itself says where its frames are.
    """

    sweep: Sweep
    frames: IntArray
    world_from_image: RigidTransform
    mode: str
    reconstruction: Reconstruction | None = None

    def images(
        self, dynamic_range_db: float = 60.0, progress: Callable[[int, int], None] | None = None
    ) -> tuple[Images, ImageGrid]:
        """Grey images of the frames that have a pose, in the order of their poses, and their grid."""
        every = grey_images(self.sweep, dynamic_range_db, progress, self.reconstruction)
        return ChosenImages(every, self.frames), every.grid


def open_posed(path: Path, mode: str | None = None, sweep_file: Path | None = None) -> PosedSweep:
    """Open a reconstruction with its sweep, or a recording whose poses are known.

    Parameters
    ----------
    path : path
        Reconstruction, or recording with a calibrated tracker or true poses.
    mode : str, optional
        A mode of the reconstruction (by default "image"); "tracker" or "truth" of a recording (by default
        the truth if stored, else the tracker).
    sweep_file : path, optional
        The reconstruction's sweep, if it moved.

    Raises
    ------
    InvalidInputError
        If there is no such mode.
    InsufficientDataError
        If the recording does not say where its frames are.
    """
    if kind_of(path) == FORMAT:
        reconstruction, sweep = open_reconstruction(path, sweep_file)
        chosen = mode or "image"
        return PosedSweep(
            sweep, np.arange(len(sweep)), poses_of(reconstruction, chosen), chosen, reconstruction
        )
    if sweep_file is not None:
        raise InvalidInputError(f"{path}: expected a reconstruction beside --sweep, got a recording")
    if mode is not None and mode not in REFERENCES:
        raise InvalidInputError(
            f"--mode: expected {' or '.join(REFERENCES)} of a recording, got {mode!r}: "
            "make its reconstruction first (speckle3d reconstruct)"
        )
    sweep = load_sweep(path)
    return posed_by_itself(sweep, mode)


def posed_by_itself(sweep: Sweep, mode: str | None = None) -> PosedSweep:
    """Take a sweep's true poses, or its tracker's where it has any; as for `open_posed`."""
    reference = find_reference(sweep, mode)
    if reference is None:
        raise InsufficientDataError(
            f"{sweep.name}: expected a calibrated tracker or true poses, got none: make a reconstruction "
            "first (speckle3d reconstruct)"
        )
    frames = np.flatnonzero(reference.covered)
    return PosedSweep(sweep, frames, reference.world_from_image, reference.name)
