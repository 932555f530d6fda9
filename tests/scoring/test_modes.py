"""Which mode is taken where nobody says: the one that claims the smallest error of length, or none."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import MismatchError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.reconstruction import ModeErrors, Provenance, Reconstruction, Trust
from speckle3d.scoring.modes import default_mode

GRID = ImageGrid(8, 40, 0.3, 0.1)
N = 11


def made(claims, image_sigma=0.05, length_mm=10.0):
    """A reconstruction of 10 mm by its images, and modes of other lengths with relative claims."""

    def path(length):
        return RigidTransform.from_translation(np.outer(np.linspace(0.0, length, N), [0.0, 0.0, 1.0]))

    covariance = np.zeros((N, 6, 6))
    covariance[:, 2, 2] = (image_sigma * np.linspace(0.0, length_mm, N)) ** 2
    poses = {"image": path(length_mm)} | {mode: path(length) for mode, (length, _) in claims.items()}
    modes = {mode: ModeErrors(covariance, sigma) for mode, (_, sigma) in claims.items()}
    trust = Trust(covariance, np.zeros(N, int), modes=modes)
    return Reconstruction(np.arange(N) / 25, GRID, poses, Provenance("s.h5", "", ""), trust=trust)


def test_the_smallest_claim_wins_and_its_length_is_told_with_95_percent():
    mode, why = default_mode(made({"pose": (9.9, 0.03), "fused": (9.8, 0.01)}))
    assert mode == "fused"
    assert "9.80 +- 0.19 mm (95 %)" in why


def test_beyond_three_joint_claims_there_is_none_and_both_numbers_are_told():
    within = made({"pose": (8.6, 0.01)})
    assert default_mode(within)[0] == "pose"
    with pytest.raises(MismatchError, match="--mode"):
        default_mode(made({"pose": (8.0, 0.01)}))
