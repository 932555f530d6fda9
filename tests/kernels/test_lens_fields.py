"""Field of a lens against complex exponentials in NumPy."""

import numpy as np

from speckle3d.kernels.diffraction import lens_fields


def test_field_is_the_sum_over_strips():
    strip = np.linspace(-3.0, 3.0, 61)
    elevation, distance = np.linspace(0.0, 6.0, 17), np.array([0.7, 5.0, 21.3, 60.0])
    wavenumber, delay = np.linspace(18.0, 44.0, 6), 20.0 - np.hypot(20.0, strip)
    out = np.full((distance.size, wavenumber.size, elevation.size, 2), np.nan)
    lens_fields(distance, elevation, strip, delay, wavenumber, np.ones(4), 1, 1, 4, out)
    path = np.hypot(distance[:, None, None], elevation[:, None] - strip)
    phase = wavenumber[:, None, None] * (path + delay)[:, None]
    expected = (np.exp(-1j * phase) / path[:, None]).sum(axis=-1)
    # Phases of up to 2,600 rad, in double precision: 3e-13 each.
    np.testing.assert_allclose(out[1:, ..., 0] + 1j * out[1:, ..., 1], expected[1:], rtol=0, atol=1e-12)
    assert np.isnan(out[0]).all()
