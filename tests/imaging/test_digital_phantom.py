"""The digital phantom compounded at known and at reconstructed poses: sizes come out as they are."""

import numpy as np
import pytest
from digital_phantom import INSIDE, LEVEL, OUTSIDE, Ball, Phantom, curved_path

from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.measures.surface import largest_part, measures_of, surface_of
from speckle3d.imaging.voxels.volume import compound

GRID = ImageGrid(120, 120, 0.1, 0.1)
STEP_MM = 0.25


def voxel_volume(volume, body):
    """Volume of a body by its voxels, each counted by its share of the inside."""
    index = np.moveaxis(np.indices(volume.shape), 0, -1).reshape(-1, 3)
    near = body.depth(volume.world_from_grid.apply(index * volume.spacing_mm)) > -3 * STEP_MM
    share = (volume.voxels.reshape(-1)[near] - OUTSIDE) / (INSIDE - OUTSIDE)
    return np.nansum(share) * np.prod(volume.spacing_mm)


def test_a_sphere_swept_by_hand_has_its_size():
    body = Ball((6.0, 6.0, 6.0), 3.0)
    poses = curved_path(120, 12.0, seed=1)
    images = [np.rint(image).astype(np.uint8) for image in Phantom((body,), GRID).images(poses)]
    voxels = compound(images, GRID, poses, STEP_MM)
    surface = largest_part(surface_of(voxels, LEVEL))
    assert voxel_volume(voxels, body) == pytest.approx(body.volume_mm3, rel=0.005)
    assert surface.volume_mm3 == pytest.approx(body.volume_mm3, rel=0.01)
    assert np.abs(body.depth(surface.vertices_mm)).max() < STEP_MM / 2


@pytest.mark.slow
def test_spheres_swept_at_reconstructed_poses_are_as_far_apart_and_as_large_as_claimed(shipped):
    """Cut at the true poses, compounded at the reconstructed ones, of the sweep that comes with the project.

    Each quantity lies within three claimed deviations; over many sweeps `bench_surfaces` counts.
    """
    import speckle3d as s3
    from speckle3d.imaging.measures.belonging import belonging_of
    from speckle3d.imaging.measures.measure import measured
    from speckle3d.motion.uncertainty import joint_errors

    sweep = s3.load_sweep(shipped / "phantom.h5")
    tracked = s3.track(sweep, s3.load_curves(shipped / "curves.h5"))
    grid = ImageGrid(140, 80, 0.1, 0.1, 16.0)
    frames = (18, 48, 78)
    middles = [sweep.truth[frame].apply(grid.centre_mm) for frame in frames]
    phantom = Phantom(tuple(Ball(tuple(middle), 1.4) for middle in middles), grid)
    images, centre = phantom.images(sweep.truth), sweep.grid.centre_mm
    errors = joint_errors(tracked.covariance, tracked.image, centre, tracked.shared)
    found = []
    for poses in (sweep.truth, tracked.image):
        surface = surface_of(compound(images, grid, poses, STEP_MM, splat="linear"), LEVEL)
        part, places = surface.parts(), surface.vertices_mm[surface.triangles].mean(axis=1)
        near = [np.linalg.norm(places - poses[f].apply(grid.centre_mm), axis=1).argmin() for f in frames]
        found.append([surface.of_triangles(part == part[each]) for each in near])
    for true, own in zip(*found, strict=True):
        told = measures_of(own, errors, sweep.grid)
        assert abs(told.volume_mm3 - true.volume_mm3) < 3 * told.volume_sigma_mm3
        assert told.volume_sigma_mm3 < 0.25 * told.volume_mm3
    apart, own = (np.array([each.vertices_mm.mean(axis=0) for each in side]) for side in found)
    rows = measured(own, belonging_of(own, sweep.grid, tracked.image), errors, 0.0)
    for row in rows[:2]:
        true_mm = np.linalg.norm(np.diff(apart[list(row.points)], axis=0))
        assert abs(row.value - true_mm) < 3 * row.sigma
        assert row.sigma < 0.15 * row.value
