"""Correlating the patches of one frame pair at five lags, beside OpenCV doing the same sums."""

import cv2
import numpy as np
from patch_kernels import patch_correlations

from speckle3d.config import Config
from speckle3d.core.threads import on_one_thread
from speckle3d.io.load import load_sweep
from speckle3d.matching.matcher import FrameMatcher
from speed.rows import Row, time_runs

TIMES_OPENCV = 12.0
CROSS = [1, 3, 4, 5, 7]
"""Of three by three lags those of the kernel."""


def rows(path, runs):
    """One row; the coefficients are the same to 1e-4 where all lags lie in the image."""
    sweep, config = load_sweep(path), Config()
    matcher = FrameMatcher(sweep, config)
    fixed, moving = (matcher.ready(sweep.frames[i]).frame.image for i in (0, 1))
    patches = matcher.patches
    rho, lag = np.empty((len(patches), 5)), np.zeros((len(patches), 2), dtype=np.int64)

    def by_kernel():
        patch_correlations(fixed, moving, patches.first, patches.size, lag, 0.5, rho)

    def by_opencv():
        coefficients = np.full((len(patches), 5), np.nan)
        wide, high = patches.size
        for p, (v, s) in enumerate(patches.first):
            if min(v, s) >= 1 and v + wide < fixed.shape[0] and s + high < fixed.shape[1]:
                around = moving[v - 1 : v + wide + 1, s - 1 : s + high + 1]
                template = fixed[v : v + wide, s : s + high]
                coefficients[p] = cv2.matchTemplate(around, template, cv2.TM_CCOEFF_NORMED).ravel()[CROSS]
        return coefficients

    cv2.setNumThreads(1)
    with on_one_thread():
        # Far more runs than of the other: a tenth of a millisecond is short beside what interrupts it.
        ours, peer = time_runs(by_kernel, 20 * runs).seconds, time_runs(by_opencv, runs).seconds
        assert np.nanmax(np.abs(by_opencv() - rho)) < 1e-4
    label = f"{len(patches)} patches of a pair at 5 lags, 1 core"
    row = Row(label, 1e3 * ours, "ms", "OpenCV matchTemplate", 1e3 * peer, falling=True)
    return [row, Row("patches: times as fast as matchTemplate", row.times_peer, "", target=TIMES_OPENCV)]
