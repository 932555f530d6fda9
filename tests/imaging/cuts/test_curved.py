"""Curved reslices against scenes whose place is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from speckle3d.imaging.cuts.curved import curved_sheet


def arc(radius_mm, degrees, n, tilt=None):
    angle = np.deg2rad(np.linspace(0, degrees, n))
    points = radius_mm * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    return points if tilt is None else tilt.apply(points)


def test_columns_are_even_along_an_arc_of_known_radius():
    tilt = Rotation.random(rng=np.random.default_rng(0))
    down = tilt.apply([0, 0, 1.0])
    sheet = curved_sheet(arc(20.0, 90.0, 12, tilt), down, (-2.0, 5.0), 0.1)
    # A cubic spline through 12 points of a quarter circle leaves it by less than a micrometre.
    assert 0.1 * len(sheet.base_mm) == pytest.approx(20.0 * np.pi / 2, abs=0.1)
    flat = tilt.inv().apply(sheet.base_mm)
    np.testing.assert_allclose(np.linalg.norm(flat[:, :2], axis=1), 20.0, atol=2e-3)
    np.testing.assert_allclose(flat[:, 2], -2.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(np.diff(sheet.base_mm, axis=0), axis=1), 0.1, rtol=1e-3)
    at = tilt.apply([20 * np.cos(0.5), 20 * np.sin(0.5), -2.0])
    np.testing.assert_allclose(sheet.base_mm[100], at, atol=2e-3)
