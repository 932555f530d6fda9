"""The mode to take where a reconstruction has several: that which claims the smallest error of length."""

from __future__ import annotations

import numpy as np

from speckle3d.core.errors import MismatchError
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.examine.disagreements import differing_lengths
from speckle3d.scoring.lengths import accumulated


def length_claims(reconstruction: Reconstruction) -> dict[str, tuple[float, float]]:
    """Length of each mode that claims an error of it, and its standard deviation, mm."""
    trust, centre_mm = reconstruction.trust, reconstruction.grid.centre_mm
    if trust is None:
        return {}
    z = reconstruction.poses["image"].apply(centre_mm)[:, 2]
    farthest = int(np.argmax(np.abs(z - z[0])))
    travelled = max(abs(float(z[farthest] - z[0])), 1e-9)
    relative = {"image": float(np.sqrt(trust.covariance[farthest, 2, 2])) / travelled}
    relative |= {mode: errors.length_sigma for mode, errors in trust.modes.items()}
    lengths = {
        mode: abs(float(accumulated(reconstruction.poses[mode], centre_mm).length_mm[-1]))
        for mode in relative
        if mode in reconstruction.poses
    }
    return {mode: (length, length * relative[mode]) for mode, length in lengths.items()}


def default_mode(reconstruction: Reconstruction) -> tuple[str, str]:
    """Choose a mode where nobody did; returns it and why, in words that are empty if there is no choice.

    Raises
    ------
    MismatchError
        If modes differ by more than three joint claims: there is no best one.
    """
    claims = length_claims(reconstruction)
    if doubts := differing_lengths(claims):
        raise MismatchError(f"{doubts[0].evidence}: expected --mode to say which to take, got none")
    if len(claims) < 2:
        return "image", ""
    best = min(claims, key=lambda mode: claims[mode][1])
    length, sigma = claims[best]
    return best, (
        f"mode {best}: claims the smallest error of length, {length:.2f} +- {1.96 * sigma:.2f} mm (95 %); "
        "--mode takes another"
    )
