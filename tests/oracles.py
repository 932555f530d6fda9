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
