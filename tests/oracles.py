"""Brute-force NumPy twins of the kernels: slow, plain, and written independently of them."""

import numpy as np


def reslice_nearest(
    images, pitch_mm, spacing_mm, first_depth_mm, world_from_image, points_mm, max_distance_mm
):
    """Twin of `speckle3d.kernels.reslicing.keep_nearest` and the blend: every image at every point at once.

    points_mm: (..., 3) in the world; images facing one way. Returns (...,) with NaN where unsupported.
    """
    n, vectors, samples = images.shape
    levels, distances = np.full((2, n, *points_mm.shape[:-1]), np.nan)
    for f in range(n):
        x, y, z = np.moveaxis(world_from_image[f].inv().apply(points_mm.reshape(-1, 3)), 1, 0)
        u, v = x / pitch_mm, (y - first_depth_mm) / spacing_mm
        inside = (u >= -1e-6) & (u <= vectors - 1 + 1e-6) & (v >= -1e-6) & (v <= samples - 1 + 1e-6)
        i, j = (
            np.clip(np.floor(u).astype(int), 0, vectors - 2),
            np.clip(np.floor(v).astype(int), 0, samples - 2),
        )
        a, b = np.clip(u - i, 0, 1), np.clip(v - j, 0, 1)
        im = images[f].astype(float)
        level = (1 - a) * ((1 - b) * im[i, j] + b * im[i, j + 1])
        level += a * ((1 - b) * im[i + 1, j] + b * im[i + 1, j + 1])
        near = inside & (np.abs(z) < max_distance_mm) & ~np.isnan(level)
        levels[f] = np.where(near, level, np.nan).reshape(points_mm.shape[:-1])
        distances[f] = np.where(near, z, np.nan).reshape(points_mm.shape[:-1])
    result = np.full(points_mm.shape[:-1], np.nan)
    for point in np.ndindex(result.shape):
        z, level = distances[(slice(None), *point)], levels[(slice(None), *point)]
        behind, front = [np.flatnonzero(side) for side in (z >= 0, z < 0)]
        nearest = [s[np.argmin(np.abs(z[s]))] for s in (behind, front) if s.size]
        if nearest:
            apart = sum(abs(z[k]) for k in nearest)
            one_sided = len(nearest) == 1 or apart == 0
            weights = [1.0] if one_sided else [abs(z[k]) / apart for k in nearest[::-1]]
            result[point] = sum(w * level[k] for w, k in zip(weights, nearest, strict=False))
    return result


def bin_mean(images, image_points_world, world_from_grid, spacing_mm, shape):
    """Twin of `speckle3d.kernels.compounding.add_samples`: mean of the samples nearest each voxel centre.

    images: (n, vector, sample); image_points_world: (n, vector, sample, 3). NaN where a voxel has none.
    """
    index = np.rint(world_from_grid.inv().apply(image_points_world.reshape(-1, 3)) / spacing_mm).astype(int)
    levels = images.astype(float).ravel()
    kept = ((index >= 0) & (index < shape)).all(axis=1) & ~np.isnan(levels)
    total, count = np.zeros((2, *shape))
    np.add.at(total, tuple(index[kept].T), levels[kept])
    np.add.at(count, tuple(index[kept].T), 1)
    return np.divide(total, count, out=np.full(shape, np.nan), where=count > 0)


def fill_holes(voxels, cap):
    """Twin of `speckle3d.kernels.compounding.fill_from_shell`: grow a cube until it holds a value."""
    filled = voxels.copy()
    for at in np.argwhere(np.isnan(voxels)):
        for radius in range(1, cap + 1):
            cube = voxels[tuple(slice(max(c - radius, 0), c + radius + 1) for c in at)]
            if not np.isnan(cube).all():
                filled[tuple(at)] = np.nanmean(cube)
                break
    return filled
