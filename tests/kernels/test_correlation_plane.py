import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.kernels.plane_misfit import predict_correlation

STEP_MM, WIDTH_MM, CELLS = 0.01, 0.55, 60.0
GRID_MM = np.arange(0, 3.0, STEP_MM)
AMPLITUDE = 1 / (1 + (GRID_MM / WIDTH_MM) ** 2)
"""Heavy-tailed and smooth: no beam's, so that no formula for a Gaussian one fits by chance."""


def predict(d, share=0.0, gain=1.0):
    return predict_correlation(d, AMPLITUDE, 0, AMPLITUDE.size - 1.001, STEP_MM, share, gain, CELLS, True)


@settings(deadline=None, max_examples=80)
@given(d=st.floats(0.02, 1.5), c=st.floats(0.0, 0.8), gain=st.floats(0.3, 1.0))
def test_correlation_is_the_echo_models_and_the_derivative_its_own(d, c, gain):
    # Between two knots of the table, where its slope is one number.
    d, step = STEP_MM * (np.floor(d / STEP_MM) + 0.5), 1e-5
    expected = gain * (c + (1 - c) * np.interp(d, GRID_MM, AMPLITUDE)) ** 2
    assert predict(d, c, gain)[0] == pytest.approx(expected, rel=1e-12)
    before, after = (predict(d + side * step, c, gain)[0] for side in (-1, 1))
    assert predict(d, c, gain)[1] == pytest.approx((after - before) / (2 * step), rel=1e-5, abs=1e-9)
