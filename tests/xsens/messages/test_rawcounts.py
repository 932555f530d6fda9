import numpy as np

from xsens.messages.rawcounts import RawCalibration

REAL = RawCalibration(
    256.0,
    np.array([[29232, 33453, 31626], [32611, 32545, 32542], [30349, 33547, 33016]], dtype=float),
    np.array([[1268.19, 1269.53, 1287.17], [1249.81, 1272.94, 1249.13], [8825.30, 7365.49, 7753.23]]),
    np.tile(np.eye(3), (3, 1, 1)),
)
"""Offsets and gains of a real unit, its axes taken as square."""


def test_counts_of_a_real_unit():
    """Within what its axes are off square, 0.04: 0.04 x 9.8 m/s² at most, less for the others."""
    counts = [[[29036, 34176, 44158], [32590, 32567, 32550], [25364, 35287, 30384]]]
    acceleration, rate, field = REAL.to_units(counts)
    np.testing.assert_allclose(acceleration, [[-0.121, 0.592, 9.742]], atol=0.1)
    np.testing.assert_allclose(rate, [[-0.0169, 0.0171, 0.0064]], atol=0.002)
    np.testing.assert_allclose(field, [[-0.558, 0.216, -0.353]], atol=0.03)
