"""A sweep with the poses of its frames: by a reconstruction's mode, or by what the recording itself says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from hashlib import sha256
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.core.shown import shown
from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.imaging.images import ChosenImages, Images, PosedImages
from speckle3d.imaging.voxels.settings import Levels
from speckle3d.io.calibrations import apply_calibrations, fitted_pixels, resized
from speckle3d.io.hdf5 import PathLike
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.load import kind_of, load_sweep
from speckle3d.io.reconstructions import FORMAT
from speckle3d.matching.quality import describe
from speckle3d.scoring.modes import default_mode
from speckle3d.scoring.references import REFERENCES, find_reference
from speckle3d.scoring.trajectories import poses_of
from speckle3d.study.images import grey_images, open_reconstruction

USUAL_RANGE_DB = 60.0
"""Dynamic range where nothing says another."""

_RANGE = "dynamic_range_db"


@shown
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
    range_is_known : bool
        Whether the recording says the dynamic range of its B-mode, or it is given; levels as stored need
        none.
    chosen_for : str
        Why this mode, where nobody chose it.
    """

    sweep: Sweep
    frames: IntArray
    world_from_image: RigidTransform
    mode: str
    reconstruction: Reconstruction | None = None
    range_is_known: bool = True
    chosen_for: str = ""

    def images(self, dynamic_range_db: float = USUAL_RANGE_DB) -> tuple[Images, ImageGrid]:
        """Images of the frames that have a pose, in the order of their poses, and their grid, for cuts.

        Log-compressed; B-mode of unknown range as it is stored.
        """
        source, _ = self.source("log" if self.range_is_known else "stored", dynamic_range_db)
        return source.images, source.grid

    def source(
        self,
        levels: Levels | None = None,
        dynamic_range_db: float = USUAL_RANGE_DB,
    ) -> tuple[PosedImages, str]:
        """Images to compound with their poses, and what their grey levels are in words.

        A tracker's image calibration is used whole: columns and rows lie where it has them, also if they are
        not square.

        Parameters
        ----------
        levels : {"log", "linear", "stored"}, optional
            By default as stored for B-mode, and log-compressed for echoes.
        dynamic_range_db : float
            Range of the log-compressed grey levels.

        Raises
        ------
        InvalidInputError
            If levels need the dynamic range of B-mode, and the recording does not say it; or if echoes are
            asked for as stored.
        """
        chosen = levels or ("stored" if isinstance(self.sweep.signal, BModeSettings) else "log")
        if not self.range_is_known and chosen != "stored":
            raise InvalidInputError(
                f"{self.sweep.name}: levels {chosen}: expected the dynamic range of its B-mode, got none: "
                "give --dynamic-range-db (decibels from black to white, beside the image on the scanner's "
                "screen), or take levels stored"
            )
        every = grey_images(self.sweep, dynamic_range_db, self.reconstruction, chosen)
        grid = replace(every.grid, skew_rad=self.skew_rad)
        return PosedImages(ChosenImages(every, self.frames), grid, self.world_from_image), every.meaning

    @property
    def skew_rad(self) -> float:
        """What the image calibration has beyond the rigid poses, which are the tracker's; else zero."""
        tracker = self.sweep.tracker
        return 0.0 if tracker is None or self.mode != "tracker" else tracker.image_skew_rad

    def notes(self) -> list[str]:
        """Tell why this mode was taken, which frames are left out, and which have poses that are guesses."""
        without = len(self.sweep) - len(self.frames)
        trust = self.reconstruction and self.reconstruction.trust
        flagged = describe(trust.flags) if trust else []
        left_out = f"{without} of {len(self.sweep)} frames have no valid pose and are left out"
        return [
            *filter(None, [self.chosen_for]),
            *([f"{self.sweep.name}: {left_out}"] if without else []),
            *(f"{line}: poses there are guesses" for line in flagged),
        ]


MARK = "poses_mark"
"""Field of a volume's file that says at which poses it was made, by `pose_mark`."""


def pose_mark(world_from_image: RigidTransform) -> str:
    """Mark of poses, the same for the same ones to a millionth of a millimetre."""
    rounded = np.round(world_from_image.as_matrix(), 6) + 0.0  # no negative zeros
    return sha256(np.ascontiguousarray(rounded).tobytes()).hexdigest()[:16]


def require_made_at(mark: str, poses_mark: str, where: str) -> None:
    """Raise `MismatchError` if a file's mark, if it has one, is of other poses."""
    if mark not in ("", poses_mark):
        raise MismatchError(
            f"{where}: expected it made at these poses, got poses of another reconstruction or recording: "
            "make it again (speckle3d volume, speckle3d reslice)"
        )


def open_posed(
    path: Path,
    mode: str | None = None,
    sweep_file: Path | None = None,
    settings: ImportSettings | None = None,
    calibrations: Sequence[PathLike] = (),
    dynamic_range_db: float | None = None,
) -> PosedSweep:
    """Open a reconstruction with its sweep, or a recording whose poses are known.

    Parameters
    ----------
    path : path
        Reconstruction, or recording with a calibrated tracker or true poses.
    mode : str, optional
        A mode of the reconstruction (by default that which claims the smallest error of length); "tracker" or
        "truth" of either (of a recording by default the truth if stored, else the tracker).
    sweep_file : path, optional
        The reconstruction's sweep, if it moved.
    settings : ImportSettings, optional
        What the recording does not say; of a reconstruction, its sweep's are those it was made with.
    calibrations : sequence of path
        Calibration files to use in place of what the recording says of its sensors and, unless settings
        give it, of its pixels' size.
    dynamic_range_db : float, optional
        Of B-mode that does not say its own, and only of that.

    Raises
    ------
    InvalidInputError
        If there is no such mode.
    MismatchError
        If none is named, and modes differ by more than three joint claims.
    InsufficientDataError
        If the recording does not say where its frames are.
    """
    if kind_of(path) == FORMAT:
        if calibrations or (settings is not None and settings.model_fields_set):
            raise InvalidInputError(
                f"{path}: expected a recording with what it does not say, got a reconstruction"
            )
        reconstruction, sweep = open_reconstruction(path, sweep_file)
        chosen, why = default_mode(reconstruction) if mode is None else (mode, "")
        return replace(posed_at(sweep, chosen, reconstruction), chosen_for=why)
    if sweep_file is not None:
        raise InvalidInputError(f"{path}: expected a reconstruction beside --sweep, got a recording")
    if mode not in (None, *REFERENCES):
        raise InvalidInputError(
            f"--mode: expected {' or '.join(REFERENCES)} of a recording, got {mode!r}: "
            "make its reconstruction first (speckle3d reconstruct)"
        )
    stated = settings or ImportSettings()
    sizes = {k: v for k, v in fitted_pixels(calibrations).items() if k not in stated.model_fields_set}
    sweep, range_is_known = _load(path, stated.model_copy(update=sizes), dynamic_range_db)
    mounted, _ = apply_calibrations(resized(sweep, sizes), calibrations)
    return replace(posed_at(mounted, mode), range_is_known=range_is_known)


def _load(path: Path, settings: ImportSettings, dynamic_range_db: float | None) -> tuple[Sweep, bool]:
    """Read a sweep whose grey levels may do as they are, and tell whether their dynamic range is known."""
    try:
        return load_sweep(path, settings), True
    except MissingSettingsError as error:
        if error.settings != (_RANGE,):
            lacking = tuple(name for name in error.settings if name != _RANGE)
            raise MissingSettingsError(path, lacking) from None
    stated = settings.model_copy(update={_RANGE: dynamic_range_db or USUAL_RANGE_DB})
    return load_sweep(path, stated), dynamic_range_db is not None


def posed_at(
    sweep: Sweep, mode: str | None = None, reconstruction: Reconstruction | None = None
) -> PosedSweep:
    """Take a sweep at a mode of its reconstruction, its true poses, or its tracker's; as for `open_posed`."""
    if reconstruction is not None and mode is not None and mode not in REFERENCES:
        poses = poses_of(reconstruction, mode)
        return PosedSweep(sweep, np.arange(len(sweep)), poses, mode, reconstruction)
    reference = find_reference(sweep, mode)
    if reference is None:
        raise InsufficientDataError(
            f"{sweep.name}: expected a calibrated tracker or true poses, got none: make a reconstruction "
            "first (speckle3d reconstruct)"
        )
    frames = np.flatnonzero(reference.covered)
    return PosedSweep(sweep, frames, reference.world_from_image, reference.name, reconstruction)


@dataclass(frozen=True)
class OpenedModes:
    """A sweep at the poses of several modes.

    Attributes
    ----------
    posed : PosedSweep
        Of the frames that all modes have.
    poses : dict of str to RigidTransform, length n
    reference : str
        One of the modes.
    marks : dict of str to str
        Of the poses of all frames, by `pose_mark`.
    """

    posed: PosedSweep
    poses: dict[str, RigidTransform]
    reference: str
    marks: dict[str, str]


def at_modes(first: PosedSweep, modes: Sequence[str] = (), reference: str | None = None) -> OpenedModes:
    """Take an opened sweep at several modes.

    Parameters
    ----------
    first : PosedSweep
    modes : sequence of str
        Modes of the reconstruction, "tracker" or "truth"; by default the one it is opened at.
    reference : str, optional
        What to compare them with; by default the truth or a tracker that covers all frames, if there are
        several modes, else the first.

    Raises
    ------
    InvalidInputError, InsufficientDataError
        If there is no such mode.
    """
    asked = list(dict.fromkeys(modes)) or [first.mode]
    if reference is None:
        known = find_reference(first.sweep) if len(asked) > 1 else None
        reference = asked[0] if known is None or not known.covered.all() else known.name
    every = {
        mode: posed_at(first.sweep, mode, first.reconstruction) for mode in dict.fromkeys([*asked, reference])
    }
    shared = reduce(np.intersect1d, [each.frames for each in every.values()])
    if not shared.size:
        raise InsufficientDataError(
            f"{first.sweep.name}: expected a frame that has a pose in {' and '.join(every)}, got none"
        )
    poses = {mode: each.world_from_image[np.isin(each.frames, shared)] for mode, each in every.items()}
    posed = replace(first, frames=shared, world_from_image=poses[asked[0]], mode=asked[0])
    marks = {mode: pose_mark(each.world_from_image) for mode, each in every.items()}
    return OpenedModes(posed, poses, reference, marks)
