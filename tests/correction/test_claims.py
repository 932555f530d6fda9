import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.signal import lfilter

from speckle3d.correction.claims import curve_errors


@pytest.mark.parametrize("together", [3, 10, 30])
def test_errors_of_cubics_through_readings_that_wander_are_claimed(together):
    n, sweeps = 200, 100
    # From an autoregressive process of so many readings, unit variance.
    keep = np.exp(-1.0 / together)
    drawn = np.random.default_rng(0).standard_normal((sweeps, n + 200, 6))
    errors = np.sqrt(1.0 - keep**2) * lfilter([1.0], [1.0, -keep], drawn, axis=1)[:, 200:]
    cubics = legendre.legvander(np.linspace(-1.0, 1.0, n), 3)
    onto_cubics = cubics @ np.linalg.pinv(cubics)
    off = []
    for error in errors:
        fitted = onto_cubics @ error
        claimed = np.diagonal(curve_errors(fitted - error, n)[-1])
        off.append((fitted[-1] - fitted[0]) / np.sqrt(claimed))
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.3
