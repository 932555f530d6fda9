"""A reconstruction: poses of every frame by mode, and the frame pairs they were made from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.poses import plot_poses, pose_table
from speckle3d.core.text import shown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MODES = ("image", "consistent-subset", "orientation", "pose", "crossed", "inertial", "fused")
"""Drift-correction modes a reconstruction may hold; `image` is uncorrected and always there."""


@shown
@dataclass(frozen=True)
class FramePairs:
    """Relative poses measured between frame pairs, with the distances they were fitted to.

    Attributes
    ----------
    first, second : ndarray, shape (e,)
        Frame indices, first < second.
    first_from_second : ndarray, shape (e, 4, 4)
        Pose of the second frame in the first, from all patches, mm.
    covariance : ndarray, shape (e, 6, 6)
        Of (x, y, z, tilt, yaw, roll) of that pose at the image centre, mm and rad.
    distance_mm, sigma_mm : ndarray, shape (e, p)
        Unsigned elevational distance of each patch and its standard deviation; NaN where there is none.
    used : ndarray of bool, shape (e, p)
        Whether the patch is in the orientation-consistent subset; without a sensed orientation, whether it
        took part in the plane.
    patch_centre_mm : ndarray, shape (p, 2)
        Lateral and axial position of each patch.
    """

    first: IntArray
    second: IntArray
    first_from_second: FloatArray
    covariance: FloatArray
    distance_mm: Float32Array
    sigma_mm: Float32Array
    used: BoolArray
    patch_centre_mm: FloatArray

    def __len__(self) -> int:
        return int(self.first.size)


@dataclass(frozen=True)
class CalibrationFile:
    """A calibration file that replaced the mounting of one of a sweep's sensors."""

    sensor: str
    path: str
    sha256: str


@dataclass(frozen=True)
class SourceFile:
    """A further recording that took part: the crossing sweep."""

    path: str
    sha256: str


@dataclass(frozen=True)
class ImportRecord:
    """Import settings that overrode or completed a recording's metadata.

    Attributes
    ----------
    name : str
        Of the file that gave them, beside the recording.
    settings_json : str
        All that it gave, by the names of the import settings.
    """

    name: str
    settings_json: str


@dataclass(frozen=True)
class Provenance:
    """Input files and package version that a reconstruction was made with.

    Attributes
    ----------
    imported : ImportRecord or None
        None where no settings were in force, and in older files.
    """

    input_path: str
    input_sha256: str
    package_version: str
    calibrations: tuple[CalibrationFile, ...] = ()
    crossing: SourceFile | None = None
    imported: ImportRecord | None = None


@dataclass(frozen=True)
class SharedErrors:
    """Errors common to the image-based distances of all frames; see `speckle3d.motion.uncertainty`.

    Attributes
    ----------
    scale_sigma : float
        Relative standard deviation of the scale of distances that the images leave; it changes along the
        sweep, too.
    curves_sigma : float
        That of the curves' mismatch with probe and tissue, one factor for the whole sweep.
    turn_sigma_per_mm : ndarray, shape (2,)
        Standard deviation of the yaw and the tilt that the images lack, rad/mm.
    """

    scale_sigma: float
    curves_sigma: float
    turn_sigma_per_mm: FloatArray

    @property
    def length_sigma(self) -> float:
        """Relative standard deviation of the length, of both scales together."""
        return float(np.hypot(self.scale_sigma, self.curves_sigma))


@shown
@dataclass(frozen=True)
class ModeErrors:
    """Claimed errors of the poses of a corrected mode.

    Attributes
    ----------
    covariance : ndarray, shape (n, 6, 6)
        As `Trust.covariance`, along the axes of the mode's first frame.
    length_sigma : float
        Relative standard deviation of the sweep's length.
    """

    covariance: FloatArray
    length_sigma: float


@shown
@dataclass(frozen=True)
class Trust:
    """Uncertainty and flags of the poses of mode `image`.

    Attributes
    ----------
    covariance : ndarray, shape (n, 6, 6)
        Of (x, y, z, tilt, yaw, roll) of every frame's pose about the image's centre, along the first frame's
        axes, mm and rad.
    flags : ndarray of int, shape (n,)
        Zero for a good frame; else bits of `speckle3d.matching.quality.FrameFlag`.
    shared : SharedErrors or None
        Which part of the covariance all frames have in common; None in older files.
    modes : dict of str to ModeErrors
        Of corrected modes that claim errors of their own; none in older files.
    """

    covariance: FloatArray
    flags: IntArray
    shared: SharedErrors | None = None
    modes: dict[str, ModeErrors] = field(default_factory=dict)


@shown
@dataclass(frozen=True)
class Reconstruction:
    """Poses of the frames of one sweep.

    Attributes
    ----------
    poses : dict of str to RigidTransform, each of length n
        ``world_from_image`` by mode. In `image` the first frame is the identity.
    config_toml : str
        The effective configuration.
    trust : Trust or None
        None in older files, which hold none.
    frame_time_s : ndarray, shape (n,)
        The image clock.
    grid : ImageGrid
        Of the images.
    provenance : Provenance
        What it was made from.
    pairs : FramePairs or None
        Every frame pair; None if they were not read.

    Examples
    --------
    >>> still = RigidTransform.identity(3)
    >>> grid = ImageGrid(vectors=8, samples=40, vector_pitch_mm=0.3, sample_spacing_mm=0.1)
    >>> made = Reconstruction(np.arange(3) / 25, grid, {"image": still}, Provenance("sweep.h5", "", ""))
    >>> made.poses["image"].translation.shape
    (3, 3)
    """

    frame_time_s: FloatArray
    grid: ImageGrid
    poses: dict[str, RigidTransform]
    provenance: Provenance
    config_toml: str = ""
    pairs: FramePairs | None = field(default=None, repr=False)
    trust: Trust | None = field(default=None, repr=False)

    def plot(self) -> Figure:
        """Draw length, tilt, yaw and roll of every mode against the frame, with the images' 95 % interval."""
        covariance = None if self.trust is None else self.trust.covariance
        return plot_poses(self.poses, self.grid.centre_mm, covariance)

    def to_dataframe(self, mode: str = "image") -> Any:
        """Poses of a mode as a `pandas.DataFrame`, a row for each frame; see `pose_table`."""
        if mode not in self.poses:
            raise InvalidInputError(f"mode: expected one of {', '.join(self.poses)}, got {mode!r}")
        errors = self.trust if mode == "image" or self.trust is None else self.trust.modes.get(mode)
        covariance = None if errors is None else errors.covariance
        flags = {} if self.trust is None else {"flags": self.trust.flags}
        return pose_table(
            self.poses[mode], self.grid.centre_mm, covariance, time_s=self.frame_time_s, **flags
        )

    def __post_init__(self) -> None:
        n = self.frame_time_s.size
        if "image" not in self.poses or not {*self.poses} <= {*MODES}:
            raise InvalidInputError(
                f"expected mode image, and others among {', '.join(MODES)}, got {', '.join(self.poses)}"
            )
        counts = {len(poses) for poses in self.poses.values()}
        if counts != {n}:
            raise InvalidInputError(f"poses: expected {n} of each mode, got {counts}")
