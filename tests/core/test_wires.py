import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.core.wires import WirePhantom

N_ENDS = np.array(
    [
        [[30.0, 0.0, 20.0], [30.0, 40.0, 20.0]],
        [[55.0, 0.0, 20.0], [35.0, 40.0, 20.0]],
        [[60.0, 0.0, 20.0], [60.0, 40.0, 20.0]],
    ]
)
NAMES = ("a", "b", "c")


@given(seed=st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=30)
def test_components_along_normals_make_up_the_distance_from_any_wire(seed):
    rng = np.random.default_rng(seed)
    ends = rng.normal(size=(5, 2, 3)) * 30.0
    phantom = WirePhantom(tuple("abcde"), ends)
    along = rng.uniform(-2, 2, 5)[:, None]
    foot = ends[:, 0] + along * (ends[:, 1] - ends[:, 0])
    away = np.cross(ends[:, 1] - ends[:, 0], rng.normal(size=(5, 3)))
    away *= (rng.uniform(0, 5, 5) / np.linalg.norm(away, axis=1))[:, None]
    distance = np.linalg.norm(away, axis=1)
    rows, offsets = phantom.equations(np.arange(5))
    components = np.einsum("kri,ki->kr", rows, foot + away) - offsets
    np.testing.assert_allclose(np.linalg.norm(components, axis=1), distance, atol=1e-9)


def test_an_n_has_parallel_outer_wires_and_crosses_them_where_drawn():
    phantom = WirePhantom(NAMES, N_ENDS, ((0, 1, 2),))
    assert phantom.n_shapes == ((0, 1, 2),)
    # The middle wire falls 20 mm of x over 40 mm of y: it meets x = 30 at y = 50 and x = 60 at y = -10.
    np.testing.assert_allclose(phantom.crossings_mm(), [[[30.0, 50.0, 20.0], [60.0, -10.0, 20.0]]])
