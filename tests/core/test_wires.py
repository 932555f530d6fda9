import numpy as np

from speckle3d.core.wires import WirePhantom

N_ENDS = np.array(
    [
        [[30.0, 0.0, 20.0], [30.0, 40.0, 20.0]],
        [[55.0, 0.0, 20.0], [35.0, 40.0, 20.0]],
        [[60.0, 0.0, 20.0], [60.0, 40.0, 20.0]],
    ]
)
NAMES = ("a", "b", "c")


def test_an_n_has_parallel_outer_wires_and_crosses_them_where_drawn():
    phantom = WirePhantom(NAMES, N_ENDS, ((0, 1, 2),))
    assert phantom.n_shapes == ((0, 1, 2),)
    # The middle wire falls 20 mm of x over 40 mm of y: it meets x = 30 at y = 50 and x = 60 at y = -10.
    np.testing.assert_allclose(phantom.crossings_mm(), [[[30.0, 50.0, 20.0], [60.0, -10.0, 20.0]]])
