"""Patches of one sweep's images against the other sweep, cut straight from its images.

A patch is a rectangle of grid points on one image. Where each point lies in the other sweep, the two images
nearest to it, one on either side, are sampled and blended by their distances, and the patch and what was cut
are compared by their correlation, so that neither brightness nor contrast counts.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray

PARAMETERS = 8
"""Turns about and displacements along the image's x, y, z, then relative changes of its two pixel sizes."""

LEAST_GAP = 0.1
"""Distance between two images, as part of the largest, from which their difference is taken for a slope."""


@njit(cache=True, inline="always")
def _inside(image, u, v):  # type: ignore[no-untyped-def]
    """Whether a point lies between four pixels."""
    return 0.0 <= u <= image.shape[0] - 1.0 and 0.0 <= v <= image.shape[1] - 1.0


@njit(cache=True, inline="always")
def _sample(image, u, v):  # type: ignore[no-untyped-def]
    """Grey level between four pixels and its change with either coordinate; NaN beside a NaN."""
    i = min(int(u), image.shape[0] - 2)
    j = min(int(v), image.shape[1] - 2)
    a, b = u - i, v - j
    near = image[i, j] + b * (image[i, j + 1] - image[i, j])
    far = image[i + 1, j] + b * (image[i + 1, j + 1] - image[i + 1, j])
    left = image[i, j] + a * (image[i + 1, j] - image[i, j])
    right = image[i, j + 1] + a * (image[i + 1, j + 1] - image[i, j + 1])
    return near + a * (far - near), far - near, right - left


# Sums may be taken in any order, and so several terms at once; NaN must stay what it is.
@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"})
def compare_patches(
    sample: Float32Array,
    world_from_sample: FloatArray,
    sample_pixels: FloatArray,
    source: Float32Array,
    source_from_world: FloatArray,
    source_pixels: FloatArray,
    patches: IntArray,
    sides: tuple[int, int],
    stride: int,
    max_gap_mm: float,
    least_share: float,
    alike: FloatArray,
    energy: FloatArray,
    share: FloatArray,
    normal: FloatArray,
    gradient: FloatArray,
) -> None:
    """Correlate each patch with what the other sweep shows there.

    Parameters
    ----------
    sample, source : float32, shape (m, u, v) and (n, s, t)
        Images; NaN where they show nothing.
    world_from_sample, source_from_world : float64, shape (m, 3, 4) and (n, 3, 4)
    sample_pixels, source_pixels : float64, shape (4,)
        Pixel size along u and v, and where the first pixel lies, mm.
    patches : int64, shape (p, 3)
        Image number and first u, v of each.
    sides : tuple of int
        Points of a patch along u and v.
    stride : int
        Pixels between them.
    max_gap_mm : float
        Largest distance between two images on either side of a point.
    least_share : float
        Share of a patch's points that must be supported for it to count; points without a level aside.
    alike : float64, shape (p,)
        Receives the correlations; NaN where a patch does not count.
    energy : float64, shape (p, 2)
        Receives the standard deviations of the patch and of what was cut.
    share : float64, shape (p,)
        Receives the share of points supported.
    normal, gradient : float64, shape (p, 8, 8) and (p, 8), or empty
        Receive the Gauss-Newton matrix of the patches' normalised difference, whose squared length is twice
        (1 - correlation), and the change of the correlation with the parameters. Not computed when empty.
    """
    derivatives = normal.shape[0] > 0
    count = sides[0] * sides[1]
    f, g = np.empty(count), np.empty(count)
    rows = np.zeros((PARAMETERS, count if derivatives else 1))
    ghat = np.empty(count)
    near = np.empty(source.shape[0], np.int64)
    slope = np.empty((2, 3))
    place = np.empty((2, 3))
    frame = np.empty(2, np.int64)
    distance = np.empty(2)
    level = np.empty(2)
    half_u = 0.5 * (sides[0] - 1) * stride * sample_pixels[0]
    half_v = 0.5 * (sides[1] - 1) * stride * sample_pixels[1]
    reach = math.sqrt(half_u * half_u + half_v * half_v) + max_gap_mm
    for p in range(patches.shape[0]):
        alike[p] = math.nan
        energy[p, 0] = energy[p, 1] = share[p] = 0.0
        if derivatives:
            normal[p] = 0.0
            gradient[p] = 0.0
        k, u0, v0 = patches[p]
        pose = world_from_sample[k]
        x = sample_pixels[2] + u0 * sample_pixels[0] + half_u
        y = sample_pixels[3] + v0 * sample_pixels[1] + half_v
        wx = pose[0, 0] * x + pose[0, 1] * y + pose[0, 3]
        wy = pose[1, 0] * x + pose[1, 1] * y + pose[1, 3]
        wz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 3]
        # Only images that pass near the patch can pass near its points.
        n_near = 0
        for j in range(source.shape[0]):
            t = source_from_world[j]
            if abs(t[2, 0] * wx + t[2, 1] * wy + t[2, 2] * wz + t[2, 3]) <= reach:
                near[n_near] = j
                n_near += 1
        if n_near < 2:
            continue
        n = 0
        wanted = 0
        for a in range(sides[0]):
            for b in range(sides[1]):
                u, v = u0 + a * stride, v0 + b * stride
                value = sample[k, u, v]
                if math.isnan(value):
                    continue
                wanted += 1
                x = sample_pixels[2] + u * sample_pixels[0]
                y = sample_pixels[3] + v * sample_pixels[1]
                wx = pose[0, 0] * x + pose[0, 1] * y + pose[0, 3]
                wy = pose[1, 0] * x + pose[1, 1] * y + pose[1, 3]
                wz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 3]
                distance[0] = distance[1] = max_gap_mm
                frame[0] = frame[1] = -1
                for index in range(n_near):
                    j = near[index]
                    t = source_from_world[j]
                    q = t[2, 0] * wx + t[2, 1] * wy + t[2, 2] * wz + t[2, 3]
                    s = 0 if q >= 0.0 else 1
                    if abs(q) < distance[s]:
                        px = t[0, 0] * wx + t[0, 1] * wy + t[0, 2] * wz + t[0, 3]
                        py = t[1, 0] * wx + t[1, 1] * wy + t[1, 2] * wz + t[1, 3]
                        su = (px - source_pixels[2]) / source_pixels[0]
                        sv = (py - source_pixels[3]) / source_pixels[1]
                        if _inside(source[j], su, sv):
                            found, du, dv = _sample(source[j], su, sv)
                            if not math.isnan(found):
                                distance[s], frame[s], level[s] = abs(q), j, found
                                slope[s, 0], slope[s, 1] = du / source_pixels[0], dv / source_pixels[1]
                                place[s, 0], place[s, 1], place[s, 2] = px, py, q
                if frame[0] < 0 or frame[1] < 0:
                    continue
                gap = distance[0] + distance[1]
                if gap > max_gap_mm:
                    continue
                part = distance[0] / gap
                f[n] = value
                g[n] = level[0] + part * (level[1] - level[0])
                if derivatives:
                    # Between images that all but touch, noise is no slope.
                    rise = (level[1] - level[0]) / (gap * max(gap, LEAST_GAP * max_gap_mm))
                    slope[0, 2] = rise * distance[1]
                    slope[1, 2] = rise * distance[0]
                    for c in range(PARAMETERS):
                        rows[c, n] = 0.0
                    for s in range(2):
                        amount = part if s == 1 else 1.0 - part
                        ax, ay, az = amount * slope[s, 0], amount * slope[s, 1], slope[s, 2]
                        t = source_from_world[frame[s]]
                        # The same slope along the axes of the world, then of the sample's image.
                        gx = t[0, 0] * ax + t[1, 0] * ay + t[2, 0] * az
                        gy = t[0, 1] * ax + t[1, 1] * ay + t[2, 1] * az
                        gz = t[0, 2] * ax + t[1, 2] * ay + t[2, 2] * az
                        bx = pose[0, 0] * gx + pose[1, 0] * gy + pose[2, 0] * gz
                        by = pose[0, 1] * gx + pose[1, 1] * gy + pose[2, 1] * gz
                        bz = pose[0, 2] * gx + pose[1, 2] * gy + pose[2, 2] * gz
                        px, py, pz = place[s]
                        rows[0, n] += y * bz - (py * az - pz * ay)
                        rows[1, n] += -x * bz - (pz * ax - px * az)
                        rows[2, n] += x * by - y * bx - (px * ay - py * ax)
                        rows[3, n] += bx - ax
                        rows[4, n] += by - ay
                        rows[5, n] += bz - az
                        rows[6, n] += x * bx - px * ax
                        rows[7, n] += y * by - py * ay
                n += 1
        share[p] = n / max(wanted, 1)
        if n < 6 or n < least_share * wanted:
            continue
        mean_f = mean_g = 0.0
        for i in range(n):
            mean_f += f[i]
            mean_g += g[i]
        mean_f /= n
        mean_g /= n
        ff = gg = fg = 0.0
        for i in range(n):
            df, dg = f[i] - mean_f, g[i] - mean_g
            ff += df * df
            gg += dg * dg
            fg += df * dg
        if ff <= 1e-12 or gg <= 1e-12:
            continue
        rho = fg / math.sqrt(ff * gg)
        alike[p] = rho
        energy[p, 0], energy[p, 1] = math.sqrt(ff / n), math.sqrt(gg / n)
        if not derivatives:
            continue
        norm_f, norm_g = math.sqrt(ff), math.sqrt(gg)
        for i in range(n):
            ghat[i] = (g[i] - mean_g) / norm_g
        for c in range(PARAMETERS):
            mean = along = 0.0
            for i in range(n):
                mean += rows[c, i]
            mean /= n
            for i in range(n):
                rows[c, i] = (rows[c, i] - mean) / norm_g
                along += rows[c, i] * ghat[i]
            change = 0.0
            for i in range(n):
                rows[c, i] -= along * ghat[i]
                change += rows[c, i] * (f[i] - mean_f) / norm_f
            gradient[p, c] = change
        for c in range(PARAMETERS):
            for d in range(c + 1):
                total = 0.0
                for i in range(n):
                    total += rows[c, i] * rows[d, i]
                normal[p, c, d] = normal[p, d, c] = total
