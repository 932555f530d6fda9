"""Distances, lengths and angles with their standard errors, against their formulas and repeated draws."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.poses import PoseErrors
from speckle3d.imaging.measures.belonging import belonging_of, require_inside
from speckle3d.imaging.measures.measure import angle, length, measure_points

GRID = ImageGrid(41, 81, 0.5, 0.5)
WORLD = RigidTransform.from_components([20.0, -30.0, 5.0], Rotation.from_euler("ZYX", [1.1, -0.4, 0.7]))


def bent_sweep(frames=21, length_mm=20.0):
    t = np.linspace(0, 1, frames)
    turns = Rotation.from_rotvec(np.column_stack([0.1 * t, 0.05 * np.sin(4 * t), 0.1 * t]))
    return WORLD * RigidTransform.from_components(np.column_stack([t, t**2, length_mm * t]), turns)


def some_errors(poses, seed=0, size=1.0):
    """Smooth random factors, none of the first frame's."""
    rng = np.random.default_rng(seed)
    along = np.linspace(0, 1, len(poses))
    waves = np.stack([along, along**2, np.sin(3 * along)])
    scale = size * np.array([0.1, 0.1, 0.3, 0.01, 0.01, 0.01])
    factors = np.einsum("mwc,wn->mnc", rng.normal(size=(7, 3, 6)) * scale, waves)
    return PoseErrors(factors, poses, GRID.centre_mm)


def inside(poses, places):
    """World points of (x, y, z) in the image frame of the frame nearest along the sweep."""
    frames = [round(z / 20.0 * (len(poses) - 1)) for *_, z in places]
    return np.array([poses[f].apply([x, y, 0.0]) for f, (x, y, _) in zip(frames, places, strict=True)])


def draw_points(errors, frames, points, normal):
    """Points after the frames they belong to have moved as rigid bodies, exactly: shape (draw, point, 3)."""
    first, places = errors.world_from_image[0].rotation, []
    for frame, point in zip(frames, points, strict=True):
        error = normal @ errors.factors[:, frame]
        centre = errors.world_from_image[int(frame)].apply(errors.centre_mm)
        turn = first * Rotation.from_rotvec(error[:, 3:]) * first.inv()
        places.append(centre + turn.apply(point - centre) + first.apply(error[:, :3]))
    return np.stack(places, axis=1)


def test_standard_errors_are_those_of_repeated_draws():
    """Each frame moved as a rigid body by its error, exactly; first order is what is claimed."""
    poses = bent_sweep()
    errors = some_errors(poses)
    points = inside(poses, [(5, 10, 2), (15, 30, 9), (8, 20, 18)])
    near = belonging_of(points, GRID, poses)
    rng = np.random.default_rng(1)
    places = draw_points(errors, near.frames[:, 0], points, rng.standard_normal((4000, 7)))
    places += 0.05 * rng.standard_normal(places.shape)
    values = [[length(p[:2])[0], length(p[1:])[0], length(p)[0], angle(p)[0]] for p in places]
    sigmas = [row.sigma for row in measure_points(points, near, errors, 0.05)]
    # 4000 draws: a deviation to 1.1 %, four times that; and what the second order adds.
    np.testing.assert_allclose(np.std(values, axis=0), sigmas, rtol=0.05)


def test_points_outside_the_sweep_are_refused_by_number():
    poses = bent_sweep()
    centre = poses[10].apply(GRID.centre_mm)
    with pytest.raises(InvalidInputError, match=r"point 2 .*3\.00 mm"):
        require_inside(np.array([centre, WORLD.apply([10, 20, -3.0])]), GRID, poses)
    assert require_inside(centre[None], GRID, poses).frames[0, 0] == 10
