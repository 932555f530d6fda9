"""The mode to take where a reconstruction has several: that which claims the smallest error of length."""

from __future__ import annotations

from collections.abc import Mapping

from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import MismatchError
from speckle3d.core.reconstruction import Reconstruction, Trust
from speckle3d.correction.claims import length_sigma
from speckle3d.examine.disagreements import differing_lengths
from speckle3d.scoring.lengths import part_lengths


def relative_claims(
    poses: Mapping[str, RigidTransform], trust: Trust, centre_mm: FloatArray
) -> dict[str, float]:
    """Relative standard deviation of its length by every mode that claims one."""
    claims = {"image": length_sigma(poses["image"], trust.covariance, centre_mm)}
    claims |= {mode: errors.length_sigma for mode, errors in trust.modes.items()}
    return {mode: claim for mode, claim in claims.items() if mode in poses}


def length_claims(
    poses: Mapping[str, RigidTransform], claims: Mapping[str, float], centre_mm: FloatArray
) -> dict[str, tuple[float, float]]:
    """Length of each mode with a relative claim, all parts together, and its standard deviation, mm."""
    lengths = {mode: float(parts.sum()) for mode, parts in part_lengths(poses, centre_mm)[1].items()}
    return {mode: (lengths[mode], claim * lengths[mode]) for mode, claim in claims.items()}


def default_mode(reconstruction: Reconstruction) -> tuple[str, str]:
    """Choose a mode where nobody did; returns it and why, in words that are empty if there is no choice.

    Raises
    ------
    MismatchError
        If modes differ by more than three joint claims: there is no best one.
    """
    trust, poses, centre = reconstruction.trust, reconstruction.poses, reconstruction.grid.centre_mm
    claims = {} if trust is None else relative_claims(poses, trust, centre)
    lengths = length_claims(poses, claims, centre)
    if doubts := differing_lengths(lengths):
        raise MismatchError(f"{doubts[0].evidence}: expected --mode to say which to take, got none")
    if len(claims) < 2:
        return "image", ""
    # Of modes that claim as much, the later corrects more.
    best = min(reversed(claims), key=claims.__getitem__)
    length, sigma = lengths[best]
    return best, (
        f"mode {best}: claims the smallest error of length, {length:.2f} +- {1.96 * sigma:.2f} mm (95 %); "
        "--mode takes another"
    )
