"""Brute-force NumPy twins of the kernels: slow, plain, and written independently of them."""

import numpy as np
from scipy import ndimage


def between_images(images, grid, world_from_image, points_mm, reach_mm, alone_mm=np.inf):
    """Twin of the kernels in `speckle3d.kernels.cuts`: every image at every point at once.

    points_mm: (n, 3) in the world. Returns levels, NaN where unsupported, and states: 1 where an image is no
    farther away than `alone_mm`, 2 elsewhere between two, else 0.
    """
    level, away = np.full((2, len(images), len(points_mm)), np.nan)
    first = world_from_image[0].rotation.apply([0.0, 0.0, 1.0])
    for f, pose in enumerate(world_from_image):
        x, y, z = pose.inv().apply(points_mm).T
        u, v = x / grid.vector_pitch_mm, (y - grid.first_sample_depth_mm) / grid.sample_spacing_mm
        # A millionth of a pixel outside is on the border: rounding of poses.
        at = [np.clip(u, 0, grid.vectors - 1), np.clip(v, 0, grid.samples - 1)]
        inside = np.abs(at - np.stack([u, v])).max(axis=0) < 1e-6
        level[f] = ndimage.map_coordinates(np.asarray(images[f], float), at, order=1)
        away[f] = z if pose.rotation.apply([0.0, 0.0, 1.0]) @ first >= 0 else -z
        level[f, ~inside | (np.abs(z) >= reach_mm)] = np.nan
    sides = []
    for side in (away >= 0, away < 0):
        d = np.where(side & ~np.isnan(level), np.abs(away), np.inf)
        k = d.argmin(axis=0), np.arange(d.shape[1])
        sides += [d[k], np.where(np.isfinite(d[k]), level[k], np.nan)]
    behind, low, front, high = sides
    between, near = np.isfinite(behind + front), np.minimum(behind, front) <= alone_mm
    with np.errstate(invalid="ignore"):
        blend = np.where(behind > 0, low + behind / (behind + front) * (high - low), low)
    values = np.where(between, blend, np.where(np.isfinite(behind), low, high))
    near &= ~np.isnan(values)
    return np.where(near | between, values, np.nan), np.where(near, 1, 2 * between)


def splat(images, index, shape, splat, rule, weights):
    """Twin of the kernels in `speckle3d.kernels.splatting`: every sample of every image, corner by corner.

    images, weights: (n, vector, sample); index: (n, vector, sample, 3), fractional. NaN where nothing is.
    """
    mean, over, best = np.zeros(shape), np.zeros(shape), np.full(shape, np.nan)
    for levels, points, weight in zip(images.astype(float), index, weights, strict=True):
        total, total_weight = np.zeros(shape), np.zeros(shape)
        for at, share in _corners(points, splat):
            valid = ((at >= 0) & (at < shape)).all(axis=-1) & ~np.isnan(levels) & (share > 0) & (weight > 0)
            if rule in ("latest", "maximum") and splat == "linear":
                valid &= share >= 0.125
            where = tuple(at[valid].T)
            np.add.at(total, where, (share * weight * levels)[valid])
            np.add.at(total_weight, where, (share * weight)[valid])
            np.fmax.at(best, where, levels[valid])
        if rule == "latest":
            mean[total_weight > 0], over[total_weight > 0] = 0.0, 0.0
        mean, over = mean + total, over + total_weight
    if rule == "maximum":
        return best
    return np.divide(mean, over, out=np.full(shape, np.nan), where=over > 0)


def _corners(points, splat):
    """Voxels (..., 3) that points give something, one for each corner, and the share they give it."""
    if splat == "nearest":
        yield np.floor(points + 0.5 + 2.0**-24).astype(int), np.ones(points.shape[:-1])
        return
    points = np.round(points * 1024) / 1024
    low = np.floor(points)
    for corner in np.ndindex(2, 2, 2):
        yield (low + corner).astype(int), np.prod(1 - np.abs(points - low - corner), axis=-1)


def linear_array_response(points_mm, frequency_hz, *, step_mm, pitch_mm, elements, focus_mm, widths_mm,
                          edge_weight, height_mm, lens_focus_mm, speed_m_s):  # fmt: skip
    """Two-way response of a focused linear array with a lens at points of one depth, point by point.

    A plain Rayleigh-Sommerfeld sum over squares of about `step_mm` on the array's face, elements focused
    at `focus_mm` and apodised over `widths_mm` (both: transmit, receive). points_mm: (n, 3). Returns
    (n, frequencies).
    """
    per_element = max(round(pitch_mm / step_mm), 1)
    element = (np.arange(elements) - (elements - 1) / 2) * pitch_mm
    x = np.add.outer(element, ((np.arange(per_element) + 0.5) / per_element - 0.5) * pitch_mm)
    z = ((np.arange(round(height_mm / step_mm)) + 0.5) / round(height_mm / step_mm) - 0.5) * height_mm
    lens_path = lens_focus_mm - np.sqrt(lens_focus_mm**2 + z**2)
    k = 2e-3 * np.pi * np.asarray(frequency_hz) / speed_m_s
    apertures = []
    for focus, width in zip(focus_mm, widths_mm, strict=True):
        hump = edge_weight + (1 - edge_weight) * np.cos(np.pi * element / width) ** 2
        weight = np.where(np.abs(element) <= width / 2, hump, 0)
        apertures.append(weight[:, None] * np.exp(-1j * np.outer(focus - np.sqrt(focus**2 + element**2), k)))
    out = []
    for px, py, pz in points_mm:
        r = np.sqrt((px - x[:, :, None]) ** 2 + py**2 + (pz - z) ** 2)[..., None]
        field = (py / r**2 * np.exp(-1j * k * (r + lens_path[:, None]))).sum(axis=(1, 2))
        out.append(np.prod([(aperture * field).sum(axis=0) for aperture in apertures], axis=0))
    return np.array(out)


def scatter_echoes(position_mm, amplitude, vector_mm, field, reach, curvature, grid, sample_mm,
                   cycles_per_mm, shape):  # fmt: skip
    """Twin of `speckle3d.kernels.scatter.scatter_echoes`: every scatterer for every vector, in loops."""
    out = np.zeros(shape, complex)
    for v, vector in enumerate(vector_mm):
        for (px, py, pz), a in zip(position_mm, amplitude, strict=True):
            at = np.array([(py - grid[0]) / grid[1], abs(px - vector) / grid[2], abs(pz) / grid[3]])
            low = np.floor(at).astype(int)
            if (low < 0).any() or (low[:2] > np.array(field.shape[:2]) - 2).any():
                continue
            if low[2] >= reach[low[0], low[1]]:
                continue
            value = 0
            for corner in np.ndindex(2, 2, 2):
                weight = np.prod(np.where(np.array(corner) == 1, at - low, 1 - (at - low)))
                value = value + weight * field[tuple(low + corner)]
            part = at[0] - low[0]
            kx, kz = (1 - part) * curvature[low[0]] + part * curvature[low[0] + 1]
            path = py + kx * (px - vector) ** 2 + kz * pz**2
            sample = int(path / sample_mm)
            late = path / sample_mm - sample
            value = a * value * np.exp(-2j * np.pi * cycles_per_mm * path)
            out[v, sample] += (1 - late) * value
            out[v, sample + 1] += late * value
    return out


def of_patches(fixed, moving, first, size, shift, least_overlap, alike):
    """Twin of the kernels in `patch_kernels`: `alike` of the samples that lie in both frames at every lag.

    alike: function of both frames' samples and of their places in the patch, (n, 2). Returns (p, 3, 3).
    """
    out, places = np.full((len(first), 3, 3), np.nan), np.indices(size).reshape(2, -1).T
    fixed, moving = (np.pad(image, 50, constant_values=np.nan) for image in (fixed, moving))
    for p, (corner, about) in enumerate(zip(first, shift, strict=True)):
        at = 50 + np.add(corner, places)
        a = fixed[tuple(at.T)]
        b = {lag: moving[tuple((at + about + np.subtract(lag, 1)).T)] for lag in np.ndindex(3, 3)}
        common = np.isfinite([a, *b.values()]).all(axis=0)
        if common.any() and common.sum() >= least_overlap * common.size:
            for lag, second_samples in b.items():
                out[p][lag] = alike(a[common], second_samples[common], places[common])
    return out


def pearson(a, b, _):
    return np.corrcoef(a, b)[0, 1] if np.ptp(a) > 0 and np.ptp(b) > 0 else np.nan


def coherence(ramp_rad):
    """Squared coherence of complex samples, a ramp of phase undone on the second."""

    def alike(a, b, places):
        energy = np.vdot(a, a).real * np.vdot(b, b).real
        without_ramp = b * np.exp(1j * places @ ramp_rad)
        return np.abs(np.vdot(a, without_ramp)) ** 2 / energy if energy > 0 else np.nan

    return alike
