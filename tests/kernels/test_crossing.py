"""Points looked up in images along a bent path."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.kernels.crossing import look_up

SHAPE, PIXELS = (12, 9, 11), np.array([0.3, 0.5, -1.2, -2.5])


def test_grey_levels_that_grow_evenly_in_space_are_found_with_their_slopes():
    rng, along = np.random.default_rng(5), 0.4 * np.arange(SHAPE[0])
    turns = Rotation.from_rotvec(0.01 * rng.normal(size=3) * along[:, None])
    poses = RigidTransform.from_components(
        np.stack([0.1 * np.sin(along), 0.05 * along, along], axis=1), turns
    )
    local = np.indices(SHAPE[1:]).reshape(2, -1).T * PIXELS[:2] + PIXELS[2:]
    places = np.stack([pose.apply(np.pad(local, ((0, 0), (0, 1)))) for pose in poses])
    growth = np.array([1.0, -0.7, 0.4])
    volume = (places @ growth).reshape(SHAPE).astype(np.float32)
    volume[4, 3, 5] = np.nan
    points = rng.uniform([-1.4, -2.8, -0.3], [1.4, 2.8, 4.8], (400, 3))
    values, place, slopes = np.empty(400), np.empty(400), np.zeros((400, 3))
    planes = np.ascontiguousarray(poses.inv().as_matrix()[:, :3])
    look_up(points, volume, planes, PIXELS, values, slopes, place)
    finite = np.isfinite(values)
    # Inside the images all but those beside the one that is missing.
    low, high = PIXELS[2:], PIXELS[2:] + PIXELS[:2] * np.subtract(SHAPE[1:], 1)
    inside = ((points[:, :2] > low + 0.3) & (points[:, :2] < high - 0.3)).all(axis=1)
    inside &= (points[:, 2] > 0.1) & (points[:, 2] < 4.3)
    assert inside.sum() > 150
    assert 0 < (~finite & inside).sum() < 10
    # Neighbouring planes are turned by 0.004 rad against each other, 0.4 mm apart.
    np.testing.assert_allclose(values[finite], points[finite] @ growth, atol=2e-3)
    np.testing.assert_allclose(slopes[finite], np.tile(growth, (finite.sum(), 1)), atol=0.02)
