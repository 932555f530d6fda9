"""Spheres, cut by formula along a path by hand, compounded in three ways at known poses.

Run: ``python tests/benchmarks/bench_surfaces.py``.
"""

import bench
import numpy as np
from digital_phantom import LEVEL, Ball, Phantom, by_hand, voxel_volume

from speckle3d.core.grid import ImageGrid
from speckle3d.core.volume import Volume
from speckle3d.imaging.images import PosedImages
from speckle3d.imaging.measures.surface import surface_of
from speckle3d.imaging.voxels.grid import grid_around
from speckle3d.imaging.voxels.volume import compound, look_up_voxels

BALLS = (
    Ball((5.0, 6.0, 6.0), 3.0),
    Ball((14.0, 7.0, 7.0), 4.0),
    Ball((6.0, 16.0, 9.0), 5.0),
    Ball((15.0, 17.0, 18.0), 2.0),
)
WAYS = ("nearest", "linear", "backward")
"""Of compounding, the first two into means."""
STEP_MM = 0.25


def volume_by(way, images, grid, poses, voxel_grid):
    if way != "backward":
        return compound(images, grid, poses, voxel_grid=voxel_grid, splat=way)
    voxels, _ = look_up_voxels(PosedImages(images, grid, poses), voxel_grid, 0.5)
    return Volume(voxels.T, voxel_grid.spacing_mm, voxel_grid.world_from_grid)


def main():
    parser = bench.parser_of(__doc__)
    parser.add_argument("--balls", type=int, default=len(BALLS))
    parser.add_argument("--frames", type=int, default=220)
    options = bench.parse_options(parser, balls=1, frames=110)
    balls = BALLS[: options.balls]
    phantom = Phantom(balls, ImageGrid(200, 230, 0.1, 0.1))
    poses = by_hand(options.frames, 0.1 * options.frames)
    images, grid = phantom.images(poses), phantom.grid
    voxel_grid = grid_around(grid, poses, STEP_MM)
    print(f"known poses; voxels of {STEP_MM} mm, images 0.1 mm apart with pixels of 0.1 mm")
    print("            radius   volume, % of voxels   of mesh   vertices off, voxels: most, rms")
    for way in WAYS:
        volume = volume_by(way, images, grid, poses, voxel_grid)
        surface = surface_of(volume, LEVEL)
        part, middles = surface.parts(), surface.vertices_mm[surface.triangles].mean(axis=1)
        for ball in balls:
            sphere = surface.of_triangles(part == part[np.abs(ball.depth(middles)).argmin()])
            away = np.abs(ball.depth(sphere.vertices_mm)) / STEP_MM
            sizes = [voxel_volume(volume, ball, STEP_MM), sphere.volume_mm3]
            of_voxels, of_mesh = (100 * (size / ball.volume_mm3 - 1) for size in sizes)
            off = f"{away.max():22.2f}{np.sqrt((away**2).mean()):6.2f}"
            print(f"{way:10}{ball.radius_mm:5.1f} mm{of_voxels:+21.2f}{of_mesh:+10.2f}{off}")


if __name__ == "__main__":
    main()
