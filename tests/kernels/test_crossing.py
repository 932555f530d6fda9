"""Points looked up in images along a bent path."""

import numpy as np
import oracles
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.kernels.crossing import look_up


def bent_planes(rng):
    along = np.arange(12) * 0.4
    turns = Rotation.from_rotvec(0.01 * rng.normal(size=3) * along[:, None])
    poses = RigidTransform.from_components(
        np.stack([0.1 * np.sin(along), 0.05 * along, along], axis=1), turns
    )
    return np.ascontiguousarray(poses.inv().as_matrix()[:, :3])


def test_values_are_the_twins_and_slopes_their_differences():
    rng = np.random.default_rng(5)
    volume = rng.normal(size=(12, 9, 11)).astype(np.float32)
    volume[4, 3, 5] = np.nan
    planes, pixels = bent_planes(rng), np.array([0.3, 0.5, -1.2, -2.5])
    points = rng.uniform([-1.4, -2.8, -0.3], [1.4, 2.8, 4.8], (400, 3))
    values, place, slopes = np.empty(400), np.empty(400), np.zeros((400, 3))
    look_up(points, volume, planes, pixels, values, slopes, place)
    expected = oracles.look_up_on_planes(points, volume, planes, pixels)
    np.testing.assert_allclose(values, expected, atol=1e-6)
    assert 100 < np.isfinite(values).sum() < 400
    # Within a cell the interpolation is trilinear: differences over 1 um are its slope but for the curvature.
    for axis in range(3):
        moved = []
        for sign in (1, -1):
            other = np.empty(400)
            there = points + sign * 5e-4 * np.eye(3)[axis]
            look_up(there, volume, planes, pixels, other, np.empty((400, 3)), place)
            moved.append(other)
        difference = (moved[0] - moved[1]) / 1e-3
        kept = np.isfinite(difference) & np.isfinite(values)
        off = np.abs(difference - slopes[:, axis])[kept]
        # Points within 0.5 um of a cell's side have the mean of two slopes.
        assert np.quantile(off, 0.97) < 0.02
