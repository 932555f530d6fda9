"""Reading posed images where other planes meet them: bilinear samples, patches of crossing sweeps.

A patch's point is blended from the two images nearest to it, one on either side.
A patch is a rectangle of grid points on one sweep's image; it and what the other sweep shows there are
compared by their correlation, so that neither brightness nor contrast counts.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray

PARAMETERS = 6
"""Turns about and displacements along the image's x, y, z."""

LEAST_GAP = 0.1
"""Distance between two images, as part of the largest, from which their difference is taken for a slope."""


class PlacedImages(NamedTuple):
    """Images, where they are, and how large their pixels are.

    Attributes
    ----------
    images : float32, shape (n, u, v)
        NaN where they show nothing.
    poses : float64, shape (n, 3, 4)
        World from image for images whose points are looked up, image from world for those that are cut.
    pixels : float64, shape (4,)
        Pixel size along u and v, and where the first pixel lies, mm.
    """

    images: Float32Array
    poses: FloatArray
    pixels: FloatArray


class ImagePatches(NamedTuple):
    """Rectangles of grid points on images.

    Attributes
    ----------
    where : int64, shape (p, 3)
        Image number and first u, v of each.
    sides : tuple of int
        Points along u and v.
    stride : int
        Pixels between points.
    """

    where: IntArray
    sides: tuple[int, int]
    stride: int


class PatchScores(NamedTuple):
    """Results of `compare_patches`.

    Attributes
    ----------
    alike : float64, shape (p,)
        Correlation; NaN where a patch does not count.
    energy : float64, shape (p, 2)
        Standard deviations of the patch and of what was cut.
    share : float64, shape (p,)
        Share of points supported.
    normal, gradient : float64, shape (p, 6, 6) and (p, 6), or empty
        Gauss-Newton matrix of the patches' normalised difference, whose squared length is twice
        (1 - correlation), and the change of the correlation with the parameters. Not computed when empty.
    """

    alike: FloatArray
    energy: FloatArray
    share: FloatArray
    normal: FloatArray
    gradient: FloatArray


@njit(cache=True, inline="always", error_model="numpy", fastmath=False)
def bilinear(image, u, v):  # type: ignore[no-untyped-def]
    """Grey level at a point of the image and its change with either coordinate; NaN beside a NaN."""
    # In an image one pixel wide the lower neighbour is number -1, which is that pixel too.
    i = min(int(u), image.shape[0] - 2)
    j = min(int(v), image.shape[1] - 2)
    a, b = u - i, v - j
    near = image[i, j] + b * (image[i, j + 1] - image[i, j])
    far = image[i + 1, j] + b * (image[i + 1, j + 1] - image[i + 1, j])
    left = image[i, j] + a * (image[i + 1, j] - image[i, j])
    right = image[i, j + 1] + a * (image[i + 1, j + 1] - image[i, j + 1])
    return near + a * (far - near), far - near, right - left


@njit(cache=True, inline="always", error_model="numpy", fastmath=False)
def coordinates(pose, x, y, z):  # type: ignore[no-untyped-def]
    """Coordinates of a point in the frame that rows of a pose, shape (3 or more, 4), lead to."""
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3],
    )


@njit(cache=True, inline="always", error_model="numpy", fastmath=False)
def _turned_back(pose, x, y, z):  # type: ignore[no-untyped-def]
    """Components of a vector in the frame that a pose leads from."""
    return (
        pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z,
        pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z,
        pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z,
    )


_SUMS_IN_ANY_ORDER = {"reassoc", "contract", "arcp", "nsz"}
"""Lets the compiler sum several terms at once; NaN keeps its meaning."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def compare_patches(
    sample: PlacedImages,
    source: PlacedImages,
    patches: ImagePatches,
    max_gap_mm: float,
    least_share: float,
    out: PatchScores,
) -> None:
    """Correlate each patch with what the other sweep shows there.

    Parameters
    ----------
    sample, source : PlacedImages
        The sweep with the patches, by world from image, and the one that is cut, by image from world.
    patches : ImagePatches
        On images of `sample`.
    max_gap_mm : float
        Largest distance between two images on either side of a point.
    least_share : float
        Share of a patch's points that must be supported for it to count; points without a level aside.
    out : PatchScores
        Filled.
    """
    derivatives = out.normal.shape[0] > 0
    size = patches.sides[0] * patches.sides[1]
    f, g = np.empty(size), np.empty(size)
    rows = np.zeros((PARAMETERS, size if derivatives else 1))
    near = np.empty(source.images.shape[0], np.int64)
    planes = np.empty((5, source.images.shape[0]))
    for p in range(patches.where.shape[0]):
        out.alike[p] = math.nan
        out.energy[p, 0] = out.energy[p, 1] = out.share[p] = 0.0
        if derivatives:
            out.normal[p] = 0.0
            out.gradient[p] = 0.0
        n_near = _images_near(sample, source, patches, p, max_gap_mm, near)
        if n_near < 2:
            continue
        n, total = _cut_patch(
            sample, source, patches, p, max_gap_mm, near[:n_near], planes, f, g, rows, derivatives
        )
        out.share[p] = n / max(total, 1)
        if n < 6 or n < least_share * total:
            continue
        a, b = f[:n] - f[:n].mean(), g[:n] - g[:n].mean()
        norm_a, norm_b = math.sqrt(a @ a), math.sqrt(b @ b)
        if norm_a <= 1e-6 or norm_b <= 1e-6:
            continue
        a /= norm_a
        b /= norm_b
        out.alike[p] = a @ b
        out.energy[p, 0], out.energy[p, 1] = norm_a / math.sqrt(n), norm_b / math.sqrt(n)
        if derivatives:
            _differentiate(a, b, norm_b, rows, out.normal[p], out.gradient[p])


@register_jitable(fastmath=_SUMS_IN_ANY_ORDER, error_model="numpy")
def _images_near(
    sample: PlacedImages,
    source: PlacedImages,
    patches: ImagePatches,
    p: int,
    max_gap_mm: float,
    near: IntArray,
) -> int:
    """Fill `near` with the numbers of images that pass near patch `p`; return how many."""
    pixels = sample.pixels
    half_u = 0.5 * (patches.sides[0] - 1) * patches.stride * pixels[0]
    half_v = 0.5 * (patches.sides[1] - 1) * patches.stride * pixels[1]
    reach = math.sqrt(half_u * half_u + half_v * half_v) + max_gap_mm
    k, u0, v0 = patches.where[p]
    x = pixels[2] + u0 * pixels[0] + half_u
    y = pixels[3] + v0 * pixels[1] + half_v
    wx, wy, wz = coordinates(sample.poses[k], x, y, 0.0)
    count = 0
    for j in range(source.poses.shape[0]):
        if abs(coordinates(source.poses[j], wx, wy, wz)[2]) <= reach:
            near[count] = j
            count += 1
    return count


@register_jitable(fastmath=_SUMS_IN_ANY_ORDER, error_model="numpy")
def _cut_patch(
    sample: PlacedImages,
    source: PlacedImages,
    patches: ImagePatches,
    p: int,
    max_gap_mm: float,
    near: IntArray,
    planes: FloatArray,
    f: FloatArray,
    g: FloatArray,
    rows: FloatArray,
    derivatives: bool,
) -> tuple[int, int]:
    """Fill levels of a patch (`f`), of its cut (`g`) and derivatives; return points supported and in all.

    `planes`, shape (5, n), holds the planes of the images near the patch, and their distances from a point.
    """
    slope, place = np.empty((2, 3)), np.empty((2, 3))
    frame, best, distance, level = np.empty(2, np.int64), np.empty(2, np.int64), np.empty(2), np.empty(2)
    k, u0, v0 = patches.where[p]
    pose, image, pixels, cut_pixels = sample.poses[k], sample.images[k], sample.pixels, source.pixels
    last_u, last_v = source.images.shape[1] - 1.0, source.images.shape[2] - 1.0
    n_near = near.shape[0]
    for index in range(n_near):
        for c in range(4):
            planes[c, index] = source.poses[near[index], 2, c]
    away = planes[4]
    n = 0
    total = 0
    for a in range(patches.sides[0]):
        for b in range(patches.sides[1]):
            u, v = u0 + a * patches.stride, v0 + b * patches.stride
            value = image[u, v]
            if math.isnan(value):
                continue
            total += 1
            x = pixels[2] + u * pixels[0]
            y = pixels[3] + v * pixels[1]
            wx, wy, wz = coordinates(pose, x, y, 0.0)
            for index in range(n_near):
                away[index] = (
                    planes[0, index] * wx + planes[1, index] * wy + planes[2, index] * wz + planes[3, index]
                )
            distance[0] = distance[1] = max_gap_mm
            best[0] = best[1] = -1
            for index in range(n_near):
                q = away[index]
                if q >= 0.0:
                    if q < distance[0]:
                        distance[0], best[0] = q, index
                elif -q < distance[1]:
                    distance[1], best[1] = -q, index
            frame[0] = frame[1] = -1
            for s in range(2):
                # The nearest image on this side that shows something there: mostly the first one tried.
                while best[s] >= 0:
                    px, py, _ = coordinates(source.poses[near[best[s]]], wx, wy, wz)
                    su = (px - cut_pixels[2]) / cut_pixels[0]
                    sv = (py - cut_pixels[3]) / cut_pixels[1]
                    if 0.0 <= su <= last_u and 0.0 <= sv <= last_v:
                        grey, du, dv = bilinear(source.images[near[best[s]]], su, sv)
                        if not math.isnan(grey):
                            frame[s], level[s] = near[best[s]], grey
                            slope[s, 0], slope[s, 1] = du / cut_pixels[0], dv / cut_pixels[1]
                            place[s, 0], place[s, 1], place[s, 2] = px, py, away[best[s]]
                            break
                    # That image is out of the choice, and the next nearest is tried.
                    away[best[s]] = max_gap_mm
                    distance[s], best[s] = max_gap_mm, -1
                    for index in range(n_near):
                        q = away[index] if s == 0 else -away[index]
                        if (q > 0.0 or (q == 0.0 and s == 0)) and q < distance[s]:
                            distance[s], best[s] = q, index
                if frame[s] < 0:
                    break
            if frame[0] < 0 or frame[1] < 0:
                continue
            gap = distance[0] + distance[1]
            if gap > max_gap_mm:
                continue
            part = distance[0] / gap
            f[n] = value
            g[n] = level[0] + part * (level[1] - level[0])
            if derivatives:
                # Between images that nearly touch, the difference is mostly noise.
                rise = (level[1] - level[0]) / (gap * max(gap, LEAST_GAP * max_gap_mm))
                slope[0, 2] = rise * distance[1]
                slope[1, 2] = rise * distance[0]
                _fill_rows(source.poses, frame, pose, x, y, slope, place, part, rows[:, n])
            n += 1
    return n, total


# Inlined, which costs no time; a function of its own for the images beside a point took 40 % more.
@njit(cache=True, inline="always", error_model="numpy", fastmath=False)
def _fill_rows(
    poses: FloatArray,
    frame: IntArray,
    pose: FloatArray,
    x: float,
    y: float,
    slope: FloatArray,
    place: FloatArray,
    part: float,
    row: FloatArray,
) -> None:
    """Fill in how the level cut at point (x, y) of the sample's image changes with the parameters.

    `frame`, `slope` and `place` are of the images on either side; the second counts by `part`.
    """
    row[:] = 0.0
    for s in range(2):
        amount = part if s == 1 else 1.0 - part
        ax, ay, az = amount * slope[s, 0], amount * slope[s, 1], slope[s, 2]
        # The same slope along the axes of the world, then of the sample's image.
        gx, gy, gz = _turned_back(poses[frame[s]], ax, ay, az)
        bx, by, bz = _turned_back(pose, gx, gy, gz)
        px, py, pz = place[s]
        row[0] += y * bz - (py * az - pz * ay)
        row[1] += -x * bz - (pz * ax - px * az)
        row[2] += x * by - y * bx - (px * ay - py * ax)
        row[3] += bx - ax
        row[4] += by - ay
        row[5] += bz - az


@register_jitable(fastmath=_SUMS_IN_ANY_ORDER, error_model="numpy")
def _differentiate(
    f: FloatArray,
    g: FloatArray,
    norm_g: float,
    rows: FloatArray,
    normal: FloatArray,
    gradient: FloatArray,
) -> None:
    """Gauss-Newton matrix and gradient of one patch, from normalised levels and the length `g` had."""
    n = f.shape[0]
    for c in range(PARAMETERS):
        mean = along = 0.0
        for i in range(n):
            mean += rows[c, i]
        mean /= n
        for i in range(n):
            rows[c, i] = (rows[c, i] - mean) / norm_g
            along += rows[c, i] * g[i]
        change = 0.0
        for i in range(n):
            rows[c, i] -= along * g[i]
            change += rows[c, i] * f[i]
        gradient[c] = change
    for c in range(PARAMETERS):
        for d in range(c + 1):
            total = 0.0
            for i in range(n):
                total += rows[c, i] * rows[d, i]
            normal[c, d] = normal[d, c] = total
