"""Joint errors of the poses of a reconstruction's modes, from what its file claims."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.config import Config
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.reconstruction import ModeErrors, Provenance, Reconstruction, SharedErrors, Trust
from speckle3d.motion.uncertainty import shared_covariance
from speckle3d.study.pose_errors import errors_of

GRID = ImageGrid(41, 81, 0.5, 0.5)
N = 61
Z_MM = np.linspace(0, 20, N)
SHARED = SharedErrors(0.02, 0.07, np.array([1e-3, 2e-3]))
IMAGE = RigidTransform.from_translation(np.column_stack([0 * Z_MM, 0 * Z_MM, Z_MM]))
WORLD = RigidTransform.from_components([90.0, 0.0, 7.0], Rotation.from_euler("x", 0.9))


def reconstruction(modes=("fused",), has_trust=True):
    covariance = shared_covariance(IMAGE, GRID.centre_mm, SHARED)
    claim = np.zeros((N, 6, 6))
    claim[:, 2, 2] = (0.004 * Z_MM) ** 2 + 1e-4 * Z_MM
    poses = {"image": IMAGE} | dict.fromkeys(modes, WORLD * IMAGE)
    claims = {"fused": ModeErrors(claim, 0.004)} if "fused" in modes else {}
    trust = Trust(covariance, np.zeros(N, dtype=np.int64), SHARED, claims) if has_trust else None
    provenance = Provenance("sweep.h5", "", "")
    return Reconstruction(np.arange(N) / 20.0, GRID, poses, provenance, Config().to_toml(), None, trust)


def along(errors, i, j):
    """Deviation of how far apart two frames are along the sweep."""
    return float(np.linalg.norm(errors.factors[:, j, 2] - errors.factors[:, i, 2]))


def test_an_images_length_is_as_sure_as_the_file_claims():
    file = reconstruction()
    errors = errors_of(file)
    assert along(errors, 0, N - 1) == pytest.approx(np.sqrt(file.trust.covariance[-1, 2, 2]), rel=1e-3)


def test_a_mode_with_claims_of_its_own_has_these():
    errors = errors_of(reconstruction(), "fused")
    assert along(errors, 0, N - 1) == pytest.approx(np.sqrt((0.004 * 20) ** 2 + 1e-4 * 20), rel=1e-3)


def test_errors_need_a_claim_and_a_mode():
    with pytest.raises(InsufficientDataError):
        errors_of(reconstruction(has_trust=False))
    with pytest.raises(InvalidInputError):
        errors_of(reconstruction(modes=()), "fused")
