"""The scatterer kernel against its NumPy twin."""

import numpy as np
import oracles
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.kernels.scatter import EchoGrid, field_table, scatter_echoes


def random_beam(rng):
    field = (rng.standard_normal((6, 6, 8, 3)) + 1j * rng.standard_normal((6, 6, 8, 3))).astype(np.complex64)
    reach = rng.integers(0, 8, (6, 6))
    curvature = rng.uniform(-0.05, 0.05, (6, 2))
    return field, reach, curvature, np.array([1.0, 0.5, 0.1, 0.1])


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_echoes_match_every_scatterer_for_every_vector(seed):
    rng = np.random.default_rng(seed)
    beam, vector_mm = random_beam(rng), np.array([0.0, 0.3, 0.6])
    position = rng.uniform([-1.0, 0.5, -1.0], [1.6, 4.0, 1.0], (60, 3))
    # All but on a vector, left and right of it, and beyond the first and the last.
    position[:4, 0] = 0.3 - 1e-9, 0.3 + 1e-9, -0.41, 1.01
    strength = rng.standard_normal(60).astype(np.float32)
    turn = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3))
    image_from_medium = RigidTransform.from_components(rng.uniform(-9.0, 9.0, 3), turn)
    medium_mm = image_from_medium.inv().apply(position)
    out = np.zeros((3, 400, 6), np.float32)
    scatter_echoes(
        medium_mm,
        strength,
        0.3,
        image_from_medium.as_matrix(),
        np.eye(3)[None, :2],
        field_table(*beam, 3),
        EchoGrid(0.0, 0.0115, 9.7),
        out,
    )
    twin = oracles.scatter_echoes(position, strength, vector_mm, *beam, 0.0115, 9.7, (3, 400, 3))
    np.testing.assert_allclose(
        out.view(np.complex64), twin, atol=2e-5
    )  # single precision, values of order one
