"""Score one trajectory against another, read from TUM text, a reconstruction or a sweep.

Pose errors are computed as by `evo` with the first poses laid on each other (``--align_origin``), without
scale or fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.geometry import relative_poses
from speckle3d.core.grid import ImageGrid
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.core.streams import TimedPoses
from speckle3d.io import load
from speckle3d.io.family.reconstructions import FORMAT, read_reconstruction
from speckle3d.io.formats.challenge import Landmarks
from speckle3d.io.load import load_landmarks, load_sweep, recording_sha256
from speckle3d.io.tum import read_tum
from speckle3d.scoring.displacements import challenge_score, score_row
from speckle3d.scoring.modes import default_mode
from speckle3d.scoring.references import find_reference

_ROUNDING_S = 0.5e-6
"""Rounding error of a time printed with six decimals, the fewest in common use. A probe at 100 mm/s moves
50 nm in this time."""


@dataclass(frozen=True)
class Trajectory:
    """Poses on a clock, with the grid and the landmarks of their images.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
    poses : RigidTransform, length n
        ``world_from_image``, in any world.
    grid : ImageGrid or None
        None where the file does not describe the images; the poses' origin then stands for the image centre.
    landmarks : Landmarks or None
    sweep_sha256 : str
        SHA-256 of the sweep that the poses belong to; empty where the file does not say.
    """

    name: str
    time_s: FloatArray
    poses: RigidTransform
    grid: ImageGrid | None = None
    landmarks: Landmarks | None = None
    sweep_sha256: str = ""


@dataclass(frozen=True)
class PoseError:
    """Root mean square, mean and largest error of position (mm) and of angle (degrees)."""

    rmse_mm: float
    mean_mm: float
    max_mm: float
    rmse_deg: float
    mean_deg: float
    max_deg: float

    @classmethod
    def of(cls, errors: RigidTransform) -> PoseError:
        """Errors of relative poses, which are the identity where the estimate is right."""
        sizes = np.linalg.norm(errors.translation, axis=1), np.rad2deg(errors.rotation.magnitude())
        return cls(*(float(v) for e in sizes for v in (np.sqrt(np.mean(e**2)), e.mean(), e.max())))


def kind_of(path: Path) -> str:
    """Kind of a file by its content: "reconstruction", "sweep" or "text" (anything else)."""
    try:
        return "reconstruction" if load.kind_of(path) == FORMAT else "sweep"
    except InvalidInputError:
        return "text"


def load_estimate(path: Path, mode: str | None = None) -> Trajectory:
    """Read TUM text, or one mode of a reconstruction.

    Parameters
    ----------
    path : path
    mode : str, optional
        Which poses of a reconstruction; by default those that claim the smallest error of length.
    """
    if kind_of(path) == "text":
        text = read_tum(path)
        return Trajectory(path.name, text.time_s, text.world_from_sensor)
    reconstruction = read_reconstruction(path, with_pairs=False)
    mode = default_mode(reconstruction)[0] if mode is None else mode
    return Trajectory(
        f"{path.name}, mode {mode}",
        reconstruction.frame_time_s,
        poses_of(reconstruction, mode),
        reconstruction.grid,
        sweep_sha256=reconstruction.provenance.input_sha256,
    )


def poses_of(reconstruction: Reconstruction, mode: str) -> RigidTransform:
    """Poses of one mode, or an `InvalidInputError` that lists the modes there are."""
    if mode not in reconstruction.poses:
        raise InvalidInputError(f"mode: expected one of {', '.join(reconstruction.poses)}, got {mode!r}")
    return reconstruction.poses[mode]


def load_reference(path: Path, name: str | None = None, mode: str | None = None) -> Trajectory:
    """Read TUM text, a reconstruction, or the truth or tracker of a sweep.

    Parameters
    ----------
    path : path
    name : {"tracker", "truth"}, optional
        Of a sweep; by default the truth if stored, else the tracker.
    mode
        As for `load_estimate`.

    Raises
    ------
    InsufficientDataError
        If the sweep has no reference.
    """
    if kind_of(path) != "sweep":
        return load_estimate(path, mode)
    sweep = load_sweep(path)
    reference = find_reference(sweep, name)
    if reference is None:
        raise InsufficientDataError(f"{path}: expected truth or a calibrated tracker, got neither")
    return Trajectory(
        f"{path.name}, {reference.name}",
        sweep.frame_time_s[reference.covered],
        reference.world_from_image,
        sweep.grid,
        load_landmarks(path) if reference.covered.all() else None,
        recording_sha256(path),
    )


def compare_trajectories(estimate: Trajectory, reference: Trajectory) -> dict[str, Any]:
    """Score an estimate against a reference, matched by time.

    The reference is interpolated at the estimate's times, and times it does not cover are left out.

    Parameters
    ----------
    estimate, reference : Trajectory

    Returns
    -------
    dict
        ``estimate`` and ``reference`` (their names), ``poses`` compared, ``left_out``, ``same_sweep``
        (whether both are of the same bytes, None where a file does not say), as `PoseError` [1]_ ``APE``, of
        poses with the first frames laid on each other, and ``RPE``, from each frame to the next, what
        `speckle3d.scoring.displacements.score_row` gives, and the TUS-REC ``score``, None without landmarks.

    Raises
    ------
    MismatchError
        If the two share fewer than two times.

    References
    ----------
    .. [1] M. Grupp, "evo: Python package for the evaluation of odometry and SLAM", 2017.
    """
    grid = estimate.grid or reference.grid
    stream = TimedPoses(reference.time_s, reference.poses)
    times = _snap_times(estimate.time_s, reference.time_s)
    mask = stream.covers(times)
    if (count := int(mask.sum())) < 2:
        raise MismatchError(
            f"{estimate.name} and {reference.name}: expected 2 times or more that both have, got {count}"
        )
    poses, true = estimate.poses[mask], stream.at(times[mask])
    is_whole = bool(mask.all()) and len(true) == len(reference.poses)
    marks = reference.landmarks if is_whole else None
    hashes = estimate.sweep_sha256, reference.sweep_sha256
    errors = score_row(poses, true, grid, marks)
    score = challenge_score(errors, true, grid, marks) if grid and marks else None
    return {
        "estimate": estimate.name,
        "reference": reference.name,
        "poses": count,
        "left_out": len(mask) - count,
        "same_sweep": hashes[0] == hashes[1] if all(hashes) else None,
        "APE": PoseError.of((true[0].inv() * true).inv() * (poses[0].inv() * poses)),
        "RPE": PoseError.of(relative_poses(true).inv() * relative_poses(poses)),
        **errors,
        "score": score,
    }


def _snap_times(time_s: FloatArray, onto_s: FloatArray) -> FloatArray:
    """Set times that equal a time of `onto_s` but for rounding to it, so that its ends are covered."""
    nearest = onto_s[np.rint(np.interp(time_s, onto_s, np.arange(onto_s.size))).astype(int)]
    return np.where(np.abs(nearest - time_s) <= _ROUNDING_S + np.spacing(nearest), nearest, time_s)
