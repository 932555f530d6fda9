"""Default mode of a reconstruction: the one with the smallest claimed error of length."""

from __future__ import annotations

from collections.abc import Mapping

from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import MismatchError
from speckle3d.core.reconstruction import Reconstruction, Trust
from speckle3d.correction.claims import LEAST_LENGTH_MM, length_sigma
from speckle3d.examine.disagreements import differing_lengths
from speckle3d.scoring.lengths import part_lengths


def length_claims(
    poses: Mapping[str, RigidTransform], trust: Trust, centre_mm: FloatArray
) -> dict[str, tuple[float, float]]:
    """Length of each mode that claims one, all parts together, and its standard deviation, mm."""
    claims = {"image": length_sigma(poses["image"], trust.covariance, centre_mm)}
    claims |= {mode: errors.length_sigma for mode, errors in trust.modes.items()}
    parts = part_lengths(poses, centre_mm)[1]
    lengths = {mode: max(float(parts[mode].sum()), LEAST_LENGTH_MM) for mode in claims if mode in parts}
    return {mode: (length, claims[mode] * length) for mode, length in lengths.items()}


def default_mode(reconstruction: Reconstruction) -> tuple[str, str]:
    """Choose the default mode; returns it and the reason, empty if there is no choice.

    Raises
    ------
    MismatchError
        If modes differ by more than three joint claims: there is no best one.
    """
    trust, poses, centre = reconstruction.trust, reconstruction.poses, reconstruction.grid.centre_mm
    lengths = {} if trust is None else length_claims(poses, trust, centre)
    if doubts := differing_lengths(lengths):
        raise MismatchError(f"{doubts[0].evidence}: expected --mode to say which to take, got none")
    if len(lengths) < 2:
        return "image", ""
    # Of modes that claim as much, the later corrects more.
    best = min(reversed(lengths), key=lambda mode: lengths[mode][1] / lengths[mode][0])
    words = {mode: f"{length:.2f} +- {1.96 * sigma:.2f}" for mode, (length, sigma) in lengths.items()}
    alone = "" if best == "image" else f"; the images alone: {words['image']}"
    return best, (
        f"mode {best}: claims the smallest error of length, {words[best]} mm (95 %){alone}; "
        "--mode takes another"
    )
