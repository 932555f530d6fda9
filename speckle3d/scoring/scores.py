"""Scores of trajectories as rows of a table, by the metrics of `study.points`, and the challenge's score."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.sweep import ImageGrid, Sweep
from speckle3d.io.challenge import Landmarks
from speckle3d.scoring.displacements import drift_rates, landmark_errors, pixel_errors
from speckle3d.study.job import Reference

CHALLENGE_ERRORS = ("GPE_mm", "GLE_mm", "LPE_mm", "LLE_mm")


def drift_rows(
    sweep: Sweep,
    poses: Mapping[str, RigidTransform],
    reference: Reference,
    landmarks: Landmarks | None = None,
) -> list[dict[str, Any]]:
    """Drift rates and displacement errors of every mode over the frames that have a reference.

    GLE and LLE are None without landmarks, or where the reference has gaps that landmarks could fall into.
    """
    covered, true = reference.covered, reference.world_from_image
    if not covered.all():
        landmarks = None
    return [
        {"mode": mode, **score_row(each[covered], true, sweep.grid, landmarks)}
        for mode, each in poses.items()
    ]


def score_row(
    poses: RigidTransform, true: RigidTransform, grid: ImageGrid, landmarks: Landmarks | None = None
) -> dict[str, Any]:
    """Drift rates and displacement errors of one trajectory, under the names of `study.points`."""
    rates = drift_rates(poses, true, grid.centre_mm)
    return {
        "FDR": rates.final_drift_rate,
        "ADR": rates.average_drift_rate,
        "MD_mm": rates.maximum_drift_mm,
        "SD_mm": rates.sum_of_drift_mm,
        "HD_mm": rates.hausdorff_mm,
        "EA_deg": rates.mean_angle_deg,
    } | challenge_errors(poses, true, grid, landmarks)


def challenge_errors(
    poses: RigidTransform, true: RigidTransform, grid: ImageGrid, landmarks: Landmarks | None = None
) -> dict[str, float | None]:
    """The challenge's four errors of one scan; those at landmarks None without any."""
    pixels = pixel_errors(poses, true, grid)
    marks = None if landmarks is None else landmark_errors(poses, true, landmarks.frame, landmarks.points_mm)
    return {
        "GPE_mm": pixels.global_mm,
        "GLE_mm": None if marks is None else marks.global_mm,
        "LPE_mm": pixels.local_mm,
        "LLE_mm": None if marks is None else marks.local_mm,
    }


def challenge_score(
    poses: RigidTransform, true: RigidTransform, grid: ImageGrid, landmarks: Landmarks
) -> float:
    """The challenge's final score of one scan, as of 2025 [1]_: 1 if exact, 0 if as far off as resting poses.

    The mean over the four errors of ``1 - error / error of identity poses``. Below zero where an estimate is
    worse than none.

    Raises
    ------
    InsufficientDataError
        If the reference rests, so that there is nothing to be better than.

    References
    ----------
    .. [1] TUS-REC challenge 2025, assessment criteria, ranking method.
    """
    found = challenge_errors(poses, true, grid, landmarks)
    resting = challenge_errors(RigidTransform.identity(len(true)), true, grid, landmarks)
    return _normalised(found, resting, dict.fromkeys(CHALLENGE_ERRORS, 0.0))


def scores_among(errors: Mapping[str, Mapping[str, float | None]]) -> dict[str, float]:
    """The challenge's final scores of several methods on one scan, as of 2024 [1]_.

    The mean over the four errors of ``(max - error) / (max - min)``, extremes over the methods. A method's
    score in the challenge is the mean over the scans.

    Parameters
    ----------
    errors : mapping of str to mapping
        By method, `challenge_errors` of it.

    Raises
    ------
    InvalidInputError
        If an error is missing.
    InsufficientDataError
        If all methods are alike in one of the errors.

    References
    ----------
    .. [1] TUS-REC challenge 2024, assessment criteria, ranking method.
    """
    rows = list(errors.values())
    largest, smallest = (
        {key: pick([_present(row, key) for row in rows]) for key in CHALLENGE_ERRORS} for pick in (max, min)
    )
    return {method: _normalised(row, largest, smallest) for method, row in errors.items()}


def _normalised(
    found: Mapping[str, float | None], worst: Mapping[str, float | None], best: Mapping[str, float]
) -> float:
    shares = []
    for key in CHALLENGE_ERRORS:
        span = _present(worst, key) - best[key]
        if not span > 0:
            raise InsufficientDataError(f"{key}: expected a worst and a best that differ, got {best[key]:g}")
        shares.append((_present(worst, key) - _present(found, key)) / span)
    return float(np.mean(shares))


def _present(row: Mapping[str, float | None], key: str) -> float:
    value = row.get(key)
    if value is None:
        raise InvalidInputError(f"{key}: expected a number, got none: the score needs landmarks")
    return value
