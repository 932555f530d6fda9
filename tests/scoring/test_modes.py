"""Which mode is taken where nobody says: the one that claims the smallest error of length, or none."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import MismatchError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.reconstruction import ModeErrors, Provenance, Reconstruction, Trust
from speckle3d.scoring.modes import default_mode
from speckle3d.scoring.references import error_rows

GRID = ImageGrid(8, 40, 0.3, 0.1)
N = 11


def reconstruction(claims, image_sigma=0.05, length_mm=10.0):
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
    mode, why = default_mode(reconstruction({"pose": (9.9, 0.03), "fused": (9.8, 0.01)}))
    assert mode == "fused"
    assert "9.80 +- 0.19 mm (95 %)" in why


def test_beyond_three_joint_claims_there_is_no_default():
    within = reconstruction({"pose": (8.6, 0.01)})
    assert default_mode(within)[0] == "pose"
    with pytest.raises(MismatchError, match="--mode"):
        default_mode(reconstruction({"pose": (8.0, 0.01)}))


def test_a_sweep_that_comes_back_has_the_length_of_both_ways():
    z_mm = np.concatenate([np.linspace(0.0, 8.0, 40), np.linspace(7.8, 0.3, 39)])
    poses = {
        "image": RigidTransform.from_translation(np.outer(z_mm, [0.0, 0.0, 1.0])),
        "pose": RigidTransform.from_translation(np.outer(1.01 * z_mm + 0.01, [0.0, 0.0, 1.0])),
    }
    covariance = np.zeros((79, 6, 6))
    covariance[:, 2, 2] = (0.08 * z_mm) ** 2
    trust = Trust(covariance, np.zeros(79, int), modes={"pose": ModeErrors(covariance, 0.02)})
    provenance = Provenance("s.h5", "", "")
    mode, why = default_mode(Reconstruction(np.arange(79) / 25, GRID, poses, provenance, trust=trust))
    assert mode == "pose"
    assert "15.86 +- 0.62 mm (95 %)" in why
    rows = error_rows({"image": poses["image"]}, None, GRID.centre_mm)
    assert [(row.part, row.estimate_mm) for row in rows] == [
        ("f", pytest.approx(8.0)),
        ("r", pytest.approx(7.7)),
    ]
