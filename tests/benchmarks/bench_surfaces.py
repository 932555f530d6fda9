"""Spheres and a helix, cut by formula along a curved freehand path, compounded in three ways at known poses.

Run: ``python tests/benchmarks/bench_surfaces.py``.
"""

import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from digital_phantom import INSIDE, LEVEL, OUTSIDE, Ball, Helix, Phantom, curved_path

from speckle3d.core.grid import ImageGrid
from speckle3d.core.volume import Volume
from speckle3d.imaging.images import PosedImages
from speckle3d.imaging.measures.surface import surface_of
from speckle3d.imaging.voxels.grid import grid_around
from speckle3d.imaging.voxels.volume import compound, look_up_voxels

STEP_MM = 0.25


def at_known_poses():
    """Print sizes of spheres and a helix from volumes made at known poses."""
    balls = [
        Ball((5.0, 6.0, 6.0), 3.0),
        Ball((14.0, 7.0, 7.0), 4.0),
        Ball((6.0, 16.0, 9.0), 5.0),
        Ball((15.0, 17.0, 18.0), 2.0),
    ]
    helix = Helix((10.0, 12.0, 34.0), 4.0, 4.0, 2.5, 0.9)
    phantom = Phantom((*balls, helix), ImageGrid(200, 230, 0.1, 0.1))
    poses = curved_path(480, 46.0)
    images, grid = phantom.images(poses), phantom.grid
    voxel_grid = grid_around(grid, poses, STEP_MM)
    print(f"known poses; voxels of {STEP_MM} mm, images 0.1 mm apart with pixels of 0.1 mm")
    print(f"{'':16}{'radius':>9}{'volume, % of voxels':>21}{'of mesh':>9}{'vertices off, voxels':>22}  rms")
    for way in ("nearest, mean", "linear, mean", "backward"):
        volume = _volume(way, images, grid, poses, voxel_grid)
        surface = surface_of(volume, LEVEL)
        part, middles = surface.parts(), surface.vertices_mm[surface.triangles].mean(axis=1)
        for body in (*balls, helix):
            own = surface.of_triangles(part == part[np.abs(body.depth(middles)).argmin()])
            away = np.abs(body.depth(own.vertices_mm)) / STEP_MM
            size = f"{away.max():22.2f}{np.sqrt((away**2).mean()):5.2f}"
            if isinstance(body, Helix):
                print(f"{way:16}{'helix':>9}{'':30}{size}")
                continue
            sizes = [_voxel_volume(volume, body), own.volume_mm3]
            of_voxels, of_mesh = (100 * (size / body.volume_mm3 - 1) for size in sizes)
            print(f"{way:16}{body.radius_mm:6.1f} mm{of_voxels:+21.2f}{of_mesh:+9.2f}{size}")


def _volume(way, images, grid, poses, voxel_grid):
    if way != "backward":
        return compound(images, grid, poses, voxel_grid=voxel_grid, splat=way.split(",")[0])
    voxels, _ = look_up_voxels(PosedImages(images, grid, poses), voxel_grid, 0.5)
    return Volume(voxels.T, voxel_grid.spacing_mm, voxel_grid.world_from_grid)


def _voxel_volume(volume, ball):
    """Volume of a sphere by its voxels' grey levels, each counted by its share of the inside."""
    index = np.moveaxis(np.indices(volume.shape), 0, -1)
    near = ball.depth(volume.world_from_grid.apply(index.reshape(-1, 3) * volume.spacing_mm)) > -3 * STEP_MM
    share = (volume.voxels.reshape(-1)[near] - OUTSIDE) / (INSIDE - OUTSIDE)
    return float(np.nansum(share) * np.prod(volume.spacing_mm))


if __name__ == "__main__":
    at_known_poses()
