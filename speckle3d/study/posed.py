"""A sweep with the poses of its frames, from a reconstruction or the recording itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from hashlib import sha256
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.calibration_files import apply_calibrations, fitted_pixels, resized
from speckle3d.core.arrays import IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.core.text import shown
from speckle3d.examine.frames import describe
from speckle3d.imaging.images import ChosenImages, PosedImages
from speckle3d.imaging.voxels.settings import Levels
from speckle3d.io.family.reconstructions import FORMAT
from speckle3d.io.hdf5 import PathLike
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import kind_of, open_recording
from speckle3d.scoring.modes import default_mode
from speckle3d.scoring.references import REFERENCES, find_reference
from speckle3d.scoring.trajectories import poses_of
from speckle3d.study.images import grey_images, open_reconstruction

USUAL_RANGE_DB = 60.0
"""Dynamic range where nothing says another."""

_RANGE = "dynamic_range_db"
_LEAST_REACH_MM = 0.5


@shown
@dataclass(frozen=True)
class PosedSweep:
    """A sweep with the poses of its frames.

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
    has_range : bool
        Whether the dynamic range of its B-mode is known; levels as stored need none.
    remarks : sequence of str
        Why this mode, where nobody chose it; what was assumed of the recording.
    """

    sweep: Sweep
    frames: IntArray
    world_from_image: RigidTransform
    mode: str
    reconstruction: Reconstruction | None = None
    has_range: bool = True
    remarks: Sequence[str] = ()

    def source(
        self,
        levels: Levels | None = None,
        dynamic_range_db: float = USUAL_RANGE_DB,
    ) -> tuple[PosedImages, str]:
        """Images with their poses, to compound or to cut, and what their grey levels are in words.

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
        levels = levels or ("stored" if isinstance(self.sweep.signal, BModeSettings) else "log")
        if not self.has_range and levels != "stored":
            raise InvalidInputError(
                f"{self.sweep.name}: levels {levels}: expected the dynamic range of its B-mode, got none: "
                "give `speckle3d convert` --dynamic-range-db (beside the image on the scanner's screen), or "
                "take levels stored"
            )
        images = grey_images(self.sweep, dynamic_range_db, self.reconstruction, levels)
        grid = replace(images.grid, skew_rad=self.skew_rad)
        return PosedImages(ChosenImages(images, self.frames), grid, self.world_from_image), images.meaning

    @property
    def skew_rad(self) -> float:
        """Skew of the image calibration, which rigid poses lack, at the tracker's poses; else zero."""
        tracker = self.sweep.tracker
        return 0.0 if tracker is None or self.mode != "tracker" else tracker.image_skew_rad

    def notes(self) -> list[str]:
        """Tell what was assumed, which frames are left out, and which have poses that are guesses."""
        lines, total = [*self.remarks], len(self.sweep)
        if missing := total - len(self.frames):
            lines.append(
                f"{self.sweep.name}: {missing} of {total} frames have no valid pose and are left out"
            )
        trust = self.reconstruction and self.reconstruction.trust
        if trust:
            lines += describe(trust.flags)
        return lines


MARK = "poses_mark"
"""Field of a volume's file that says at which poses it was made, by `pose_mark`."""


def pose_mark(world_from_image: RigidTransform) -> str:
    """Hash of poses rounded to a millionth of a millimetre."""
    matrices = np.round(world_from_image.as_matrix(), 6) + 0.0  # no negative zeros
    return sha256(np.ascontiguousarray(matrices).tobytes()).hexdigest()[:16]


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
                f"{path}: expected no calibration and no settings of a recording beside a reconstruction, "
                "whose sweep is taken as it was reconstructed"
            )
        reconstruction, sweep = open_reconstruction(path, sweep_file)
        mode, why = default_mode(reconstruction) if mode is None else (mode, "")
        return replace(posed_at(sweep, mode, reconstruction), remarks=[why] if why else [])
    if sweep_file is not None:
        raise InvalidInputError(f"{path}: expected a reconstruction beside --sweep, got a recording")
    if mode not in (None, *REFERENCES):
        raise InvalidInputError(
            f"--mode: expected {' or '.join(REFERENCES)} of a recording, got {mode!r}: "
            "make its reconstruction first (speckle3d reconstruct)"
        )
    settings = settings or ImportSettings()
    sizes = {k: v for k, v in fitted_pixels(calibrations).items() if k not in settings.model_fields_set}
    recording = open_recording(path, settings.model_copy(update=sizes))
    value, settings = recording.numbers.get(_RANGE), recording.settings
    has_range = value is None or (value.value or settings.dynamic_range_db) is not None
    if not has_range:
        settings = settings.model_copy(update={_RANGE: USUAL_RANGE_DB})
        recording = replace(recording, settings=settings)
    sweep, _ = apply_calibrations(resized(recording.sweep, sizes), calibrations)
    # Grey levels as stored need no dynamic range.
    return replace(posed_at(sweep, mode), has_range=has_range, remarks=recording.notes_without(_RANGE))


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
            "first (speckle3d reconstruct), or give --calibration, or --transform with the image's own poses "
            "if the recording has them, as ImageToReference"
        )
    frames = np.flatnonzero(reference.covered)
    return PosedSweep(sweep, frames, reference.world_from_image, reference.name, reconstruction)


@dataclass(frozen=True)
class SweepModes:
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

    @cached_property
    def reach_mm(self) -> float:
        """Distance within which frames count in cuts: twice the longest steps, so that no gaps show."""
        paths = [path.apply(self.posed.sweep.grid.centre_mm) for path in self.poses.values()]
        steps = np.linalg.norm(np.concatenate([np.diff(path, axis=0) for path in paths]), axis=1)
        return max(_LEAST_REACH_MM, round(2.0 * float(np.percentile([0.0, *steps], 99)), 1))


def at_modes(first: PosedSweep, modes: Sequence[str] = (), reference: str | None = None) -> SweepModes:
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
    modes = list(dict.fromkeys(modes)) or [first.mode]
    if reference is None:
        basis = find_reference(first.sweep) if len(modes) > 1 else None
        reference = modes[0] if basis is None or not basis.covered.all() else basis.name
    sweeps = {
        mode: posed_at(first.sweep, mode, first.reconstruction) for mode in dict.fromkeys([*modes, reference])
    }
    frames = reduce(np.intersect1d, [sweep.frames for sweep in sweeps.values()])
    if not frames.size:
        raise InsufficientDataError(
            f"{first.sweep.name}: expected a frame that has a pose in {' and '.join(sweeps)}, got none"
        )
    poses = {mode: sweep.world_from_image[np.isin(sweep.frames, frames)] for mode, sweep in sweeps.items()}
    posed = replace(first, frames=frames, world_from_image=poses[modes[0]], mode=modes[0])
    marks = {mode: pose_mark(sweep.world_from_image) for mode, sweep in sweeps.items()}
    return SweepModes(posed, poses, reference, marks)
