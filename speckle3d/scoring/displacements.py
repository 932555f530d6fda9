"""Displacement of points and drift of the image centre against a reference, as table rows; TUS-REC's score.

Both trajectories are first laid on each other at their first frame, so that neither world matters: with
``W_i`` the pose of frame i, ``T_i = W_0^-1 W_i`` takes points of frame i into frame 0, and
``t_i = W_(i-1)^-1 W_i`` into the frame before. Hats mark the reconstruction. Frames without a reference are
left out beforehand, and the frame before is then the last one that has a reference. Every mean over frames is
over i = 1 to n - 1: the first frame is right by construction.

======  ================================================================================================
FDR     final drift rate: ``d_(n-1) / L_(n-1)``, with the drift ``d_i = |T^_i c - T_i c|`` of the image
        centre c and the length of the reference's path ``L_i = sum_(k <= i) |T_k c - T_(k-1) c|``, straight
        from frame to frame; %. A jittery reference has a longer path than the probe.
ADR     average drift rate: mean over frames of ``d_i / L_i``, %; frames before the reference moves are
        left out
MD      maximum drift: largest ``d_i``, mm
SD      sum of drift: sum of ``d_i`` over the frames, mm; it grows with the number of frames
HD      symmetric Hausdorff distance of the two sets of centres ``{T^_i c}`` and ``{T_i c}``, mm: the
        farthest that a centre of either is from the nearest centre of the other. Only centres at frames
        count, not the lines between them, and order does not.
EA      error of angle: mean over frames of the angle of ``T_i^-1 T^_i`` about its axis, degrees
GPE     global pixel error: mean over frames and over all pixels p of ``|T^_i p - T_i p|``, mm. The pixels
        are the samples of every vector as they are stored, the first and the last included.
LPE     local pixel error: the same with ``t_i`` for ``T_i``
GLE     global landmark error: mean over landmarks of ``|T^_i p - T_i p|``, each at the frame i it is in, mm
LLE     local landmark error: the same with ``t_i`` for ``T_i``
======  ================================================================================================

References
----------
.. [1] M. Luo et al., "Deep Motion Network for Freehand 3D Ultrasound Reconstruction", MICCAI, 2022: names of
   FDR to EA; what they are here is what the table says.
.. [2] Q. Li et al., TUS-REC challenge, assessment criteria, 2024 and 2025: GPE to LLE.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.distance import directed_hausdorff
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.geometry import relative_poses
from speckle3d.core.grid import ImageGrid
from speckle3d.io.formats.challenge import Landmarks

MEANINGS = {
    "FDR_percent": "final drift rate: drift of the image's centre at the end, in per cent of the path",
    "ADR_percent": "average drift rate: mean over frames of the drift in per cent of the path so far",
    "MD_mm": "maximum drift of the image's centre",
    "SD_mm": "sum of the drift over the frames; it grows with their number",
    "HD_mm": "Hausdorff distance of the two sets of image centres",
    "EA_deg": "mean angle between estimated and true images",
    "GPE_mm": "global pixel error: mean shift of the pixels, from the first frame on",
    "GLE_mm": "global landmark error: the same at landmarks",
    "LPE_mm": "local pixel error: mean shift of the pixels from one frame to the next",
    "LLE_mm": "local landmark error: the same at landmarks",
}
"""What each error is, in a line, for the places where it is printed."""

CHALLENGE_ERRORS = ("GPE_mm", "GLE_mm", "LPE_mm", "LLE_mm")


def point_errors(
    poses: RigidTransform, true: RigidTransform, grid: ImageGrid | None, landmarks: Landmarks | None
) -> dict[str, Any]:
    """Displacement errors over every pixel of the images and at landmarks, `CHALLENGE_ERRORS`.

    Parameters
    ----------
    poses, true : RigidTransform, length n
        Estimate and reference of the same frames.
    grid, landmarks : optional
        Without, their errors are None. Landmarks lie in frame 1 and later: the first frame has no error.

    Raises
    ------
    InvalidInputError
        If there are no landmarks, or one is in no frame that has an error.
    """
    relative = [(path[0].inv() * path[1:], relative_poses(path)) for path in (poses, true)]
    errors: dict[str, Any] = dict.fromkeys(CHALLENGE_ERRORS)
    for letter, estimate, exact in zip("GL", *relative, strict=True):
        differences = estimate.as_matrix()[:, :3] - exact.as_matrix()[:, :3]
        if grid is not None:
            errors[f"{letter}PE_mm"] = _mean_over_pixels(differences, grid)
        if landmarks is not None:
            errors[f"{letter}LE_mm"] = _mean_over_landmarks(differences, landmarks)
    return errors


def score_row(
    poses: RigidTransform, true: RigidTransform, grid: ImageGrid | None, landmarks: Landmarks | None = None
) -> dict[str, Any]:
    """Drift rates and displacement errors of one trajectory, under the names of the module's table.

    Parameters
    ----------
    poses, true : RigidTransform, length n
        Estimate and reference.
    grid : ImageGrid or None
        None where nothing is known of the images: the drift is then that of the poses' origin, and the errors
        at pixels are None.
    landmarks : Landmarks, optional
        Without, the errors at landmarks are None.

    Raises
    ------
    InsufficientDataError
        If the reference does not move.
    MismatchError
        If they are not of the same frames, two or more.
    """
    if len(poses) != len(true) or len(true) < 2:
        raise MismatchError(f"expected 2 poses or more of both, got {len(poses)} and {len(true)}")
    centre = np.zeros(3) if grid is None else grid.centre_mm
    estimate, exact = (path[0].inv() * path for path in (poses, true))
    centres, true_centres = estimate.apply(centre), exact.apply(centre)
    path_mm = np.cumsum(np.linalg.norm(np.diff(true_centres, axis=0), axis=1))
    if not path_mm[-1] > 0:
        raise InsufficientDataError("drift rates: expected a reference that moves, got one that rests")
    drift = np.linalg.norm(centres - true_centres, axis=1)[1:]
    moves = path_mm > 0
    angle = np.rad2deg((exact[1:].rotation.inv() * estimate[1:].rotation).magnitude())
    return {
        "FDR_percent": float(100.0 * drift[-1] / path_mm[-1]),
        "ADR_percent": float(100.0 * np.mean(drift[moves] / path_mm[moves])),
        "MD_mm": float(drift.max()),
        "SD_mm": float(drift.sum()),
        "HD_mm": max(
            directed_hausdorff(a, b)[0] for a, b in ((centres, true_centres), (true_centres, centres))
        ),
        "EA_deg": float(np.mean(angle)),
        **point_errors(poses, true, grid, landmarks),
    }


def challenge_score(
    errors: Mapping[str, float], true: RigidTransform, grid: ImageGrid, landmarks: Landmarks
) -> float:
    """The challenge's final score of one scan, as of 2025 [1]_: 1 if exact, 0 if as far off as resting poses.

    The mean over the four errors of ``1 - error / error of identity poses``. Below zero where an estimate is
    worse than none.

    Parameters
    ----------
    errors : mapping of str to float
        Of `score_row`.

    References
    ----------
    .. [1] TUS-REC challenge 2025, assessment criteria, ranking method.
    """
    resting = point_errors(RigidTransform.identity(len(true)), true, grid, landmarks)
    return float(np.mean([1 - errors[key] / resting[key] for key in CHALLENGE_ERRORS]))


def _mean_over_landmarks(differences: FloatArray, landmarks: Landmarks) -> float:
    at, points, last = landmarks.frame, landmarks.points_mm, len(differences)
    if not at.size or at.min() < 1 or at.max() > last:
        raise InvalidInputError(f"landmarks: expected some, all in frames 1 to {last}, got frames {at}")
    matrices = differences[at - 1]
    shifts = matrices[:, :, 3] + np.einsum("pij,pj->pi", matrices[:, :, :3], points)
    return float(np.linalg.norm(shifts, axis=1).mean())


def _mean_over_pixels(differences: FloatArray, grid: ImageGrid) -> float:
    """Mean length of the differences over all pixels, a frame at a time."""
    x, y = np.moveaxis(grid.mm(np.arange(grid.vectors)[:, None], np.arange(grid.samples)), -1, 0)
    if grid.fan is None:
        x, y = x[:, :1], y[:1]
    means = []
    for across, down, _, middle in differences.swapaxes(1, 2):
        # |m + a x + d y|^2 in powers of y: of parallel vectors three passes over the image in place of nine.
        along = middle + x[..., None] * across
        squares = (along**2).sum(axis=-1) + 2.0 * (along @ down) * y + down @ down * y**2
        means.append(np.sqrt(np.maximum(squares, 0.0)).mean())
    return float(np.mean(means))
