"""Mirror solutions: the canonical form never changes the calibration matrix."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.chain import canonical, wrapped
from speckle3d.core.geometry import rotation_from_fixed_angles

angle = st.floats(-20.0, 20.0)
size = st.one_of(st.floats(0.01, 3.0), st.floats(-3.0, -0.01))


@given(angle, angle, angle, size, size)
def test_the_calibration_matrix_never_changes(alpha, beta, gamma, s_x, s_y):
    before = rotation_from_fixed_angles(alpha, beta, gamma).as_matrix() @ np.diag([s_x, s_y, 0.0])
    angles, pixel_mm = canonical([alpha, beta, gamma], [s_x, s_y])
    after = rotation_from_fixed_angles(*angles).as_matrix() @ np.diag([*pixel_mm, 0.0])
    # Angles of 20 rad are wrapped with an error of 20 * 1e-16.
    np.testing.assert_allclose(after, before, atol=1e-13)
    assert (pixel_mm > 0).all()
    assert abs(angles[1]) <= np.pi / 2 + 1e-12
    assert (np.abs(angles) <= np.pi + 1e-12).all()


@given(angle, angle, angle, size, size)
def test_the_canonical_form_is_its_own(alpha, beta, gamma, s_x, s_y):
    angles, pixel_mm = canonical([alpha, beta, gamma], [s_x, s_y])
    again, size_again = canonical(angles, pixel_mm)
    np.testing.assert_allclose(wrapped(again - angles), 0.0, atol=1e-12)
    np.testing.assert_array_equal(size_again, pixel_mm)


def test_both_scales_negative_turn_the_image_half_round():
    # TR 303, appendix C: "the composite transformation for gamma must be gamma <- -gamma".
    angles, pixel_mm = canonical([0.2, 0.3, 0.4], [-1.0, -2.0])
    np.testing.assert_allclose(angles, [0.2 - np.pi, -0.3, -0.4], atol=1e-12)
    np.testing.assert_array_equal(pixel_mm, [1.0, 2.0])


@pytest.mark.parametrize(("given_rad", "expected"), [(np.pi, np.pi), (-np.pi, np.pi), (7.0, 7.0 - 2 * np.pi)])
def test_angles_are_wrapped_into_one_turn(given_rad, expected):
    assert wrapped(given_rad) == pytest.approx(expected)
