"""Correlating the patches of one frame pair at five lags, beside three other ways to do the same sums."""

from pathlib import Path

import cv2
import numpy as np
from patch_kernels import patch_correlations
from scipy.signal import correlate

from speckle3d.config import Config
from speckle3d.core.threads import on_one_thread
from speckle3d.io.load import load_sweep
from speckle3d.kernels.correlation import LAGS
from speckle3d.kernels.inplane import Frame
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.patches import PatchGrid
from speed.rows import Row, timed

TIMES_OPENCV = 12.0
CROSS = [1, 3, 4, 5, 7]
"""Of three by three lags those of the kernel."""


def rows(path: Path, runs: int) -> list[Row]:
    """One row for each other way; all give the same coefficients to 1e-4."""
    sweep, config = load_sweep(path), Config()
    matcher = FrameMatcher(sweep, config.intensity, config.patches, config.inplane)
    fixed, moving = (matcher.prepare(matcher.echo(sweep.frames[i])) for i in (0, 1))
    ways = {
        "OpenCV matchTemplate": by_opencv,
        "NumPy, lag by lag": by_numpy,
        "scipy.signal.correlate": by_scipy,
    }
    cv2.setNumThreads(1)
    made = []
    patches = matcher.patches
    inner = np.array([_is_inner(first, patches.size, fixed.image.shape) for first in patches.first])
    with on_one_thread():
        found = by_kernel(fixed, moving, matcher.patches)
        # Far more runs than of the others: a tenth of a millisecond is short beside what interrupts it.
        ours = timed(lambda: by_kernel(fixed, moving, matcher.patches), 20 * runs).seconds
        for name, way in ways.items():
            # Where all lags lie in the image: there all ways do the same sums.
            other = way(fixed, moving, matcher.patches)
            assert np.abs(other[inner] - found[inner]).max() < 1e-4, name
            theirs = timed(lambda way=way: way(fixed, moving, matcher.patches), runs).seconds
            what = f"{len(matcher.patches)} patches of a pair at 5 lags, 1 core"
            made.append(Row(what, 1e3 * ours, "ms", name, 1e3 * theirs, falling=True))
    opencv = made[0].times_peer
    made.append(Row("patches: times as fast as matchTemplate", opencv, "", target=TIMES_OPENCV))
    return made


def by_kernel(fixed: Frame, moving: Frame, patches: PatchGrid) -> np.ndarray:
    """This package's."""
    rho = np.empty((len(patches), 5))
    lag = np.zeros((len(patches), 2), dtype=np.int64)
    patch_correlations(fixed.image, moving.image, patches.first, patches.size, lag, 0.5, rho)
    return rho


def by_opencv(fixed: Frame, moving: Frame, patches: PatchGrid) -> np.ndarray:
    """Each patch as a template in its neighbourhood."""
    rho = np.full((len(patches), 5), np.nan)
    for p, around, template in _neighbourhoods(fixed, moving, patches):
        rho[p] = cv2.matchTemplate(around, template, cv2.TM_CCOEFF_NORMED).ravel()[CROSS]
    return rho


def by_numpy(fixed: Frame, moving: Frame, patches: PatchGrid) -> np.ndarray:
    """Pearson's coefficient of whole patches, all of them at once for each lag."""
    flat = _whole(fixed.image, patches, (0, 0))
    rho = np.empty((len(patches), 5))
    for k, lag in enumerate(LAGS):
        rho[:, k] = np.einsum("pk,pk->p", flat, _whole(moving.image, patches, lag))
    return rho


def by_scipy(fixed: Frame, moving: Frame, patches: PatchGrid) -> np.ndarray:
    """Correlation of each patch with its neighbourhood, sums of squares by the same routine."""
    rho = np.full((len(patches), 5), np.nan)
    n = patches.size.prod()
    ones = np.ones(patches.size, dtype=np.float32)
    for p, around, template in _neighbourhoods(fixed, moving, patches):
        a, b = template - template.mean(dtype=float), around.astype(float)
        covariance = correlate(b, a, "valid")
        total, square = correlate(b, ones, "valid"), correlate(b * b, ones, "valid")
        rho[p] = (covariance / np.sqrt((a * a).sum() * (square - total**2 / n))).ravel()[CROSS]
    return rho


def _neighbourhoods(fixed: Frame, moving: Frame, patches: PatchGrid):
    """Patches with all lags in the image: number, neighbourhood in the one frame, patch in the other."""
    (wide, high) = patches.size
    for p, (v, s) in enumerate(patches.first):
        if _is_inner(patches.first[p], patches.size, fixed.image.shape):
            around = moving.image[v - 1 : v + wide + 1, s - 1 : s + high + 1]
            yield p, around, fixed.image[v : v + wide, s : s + high]


def _whole(image: np.ndarray, patches: PatchGrid, lag: tuple[int, int]) -> np.ndarray:
    """Patches displaced by a lag, less their mean and of unit norm, shape (p, samples of a patch)."""
    rows, columns = (np.arange(n) for n in patches.size)
    v = np.clip(patches.first[:, :1] + rows + lag[0], 0, image.shape[0] - 1)
    s = np.clip(patches.first[:, 1:] + columns + lag[1], 0, image.shape[1] - 1)
    flat = image[v[:, :, None], s[:, None, :]].reshape(len(patches), -1)
    flat -= flat.mean(axis=1, keepdims=True)
    return flat / np.linalg.norm(flat, axis=1, keepdims=True)


def _is_inner(first: np.ndarray, size: np.ndarray, shape: tuple[int, int]) -> bool:
    return bool((first >= 1).all() and (first + size < shape).all())
