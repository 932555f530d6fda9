"""How far tissue moved, from residuals made of noise and of a smooth displacement field."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from speckle3d.correction.crossing.fit import Parts
from speckle3d.correction.crossing.similarity import PARAMETERS, OneWay

POINTS = 3000


def moved(moved_mm, strained=0.0, noise=0.3):
    """What is found over 24 mm of tissue that moved, smooth over 9 mm, and is strained as bends take up."""
    rng = np.random.default_rng(3)
    axes = [gaussian_filter(rng.standard_normal((40, 40, 40)), 6.4) for _ in range(3)]
    ways = []
    for _ in range(2):
        points = rng.uniform(-12.0, 12.0, (POINTS, 3))
        place = tuple((points + 20).astype(int).T)
        field = moved_mm * np.stack([axis[place] / axis.std() for axis in axes], axis=1)
        slopes = rng.standard_normal((POINTS, 3))
        bends = [
            slopes[:, [k]] * points[:, [j]] ** p for p in (1, 2) for k, j in ((2, 2), (0, 0), (1, 2), (1, 0))
        ]
        rows = np.concatenate([slopes, np.cross(points, slopes), *bends], axis=1)
        rows = np.concatenate([rows, rng.standard_normal((POINTS, PARAMETERS - rows.shape[1]))], axis=1)
        values = rng.standard_normal(POINTS)
        shift = (slopes * field).sum(axis=1) + strained * rows[:, 6]
        ways.append(OneWay(values, values + shift + noise * rng.standard_normal(POINTS), rows, points))
    whole = np.concatenate([way.residuals()[1] for way in ways])
    return Parts.of(SimpleNamespace(ways=ways, weight=500.0)).moved_mm(
        500.0 * whole.T @ whole + 1e-3 * np.eye(PARAMETERS)
    )


def test_tissue_that_kept_still_did_not_move():
    # A third of the least that simulated pairs have moved by; half of it in much noise.
    assert moved(0.0) < 0.1
    # Scale is no displacement: 5 % are 0.35 mm rms over 24 mm.
    assert moved(0.0, strained=0.05) < 0.1
    assert moved(0.0, noise=1.0) < 0.15


@pytest.mark.parametrize("moved_mm", [0.2, 0.4])
def test_says_how_far_tissue_moved(moved_mm):
    # What place, turn and bends take up is known by its smoothness alone: to a factor of 2.
    assert moved_mm / 2 < moved(moved_mm) < 2 * moved_mm
    assert moved(0.3, noise=1.0) > 0.15
