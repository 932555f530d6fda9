"""Signs of unsigned frame distances, estimated over the whole sweep.

A distance has no sign. A frame is placed against several earlier ones at once, and only one side of them
agrees with all the offsets and slopes. Where a pause or a turn leaves more than one path open, all of them
are followed until the frames that come later tell them apart.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.kernels.signs import PathRules, follow_paths
from speckle3d.motion.planes import OUTLYING, PairPlanes

HYPOTHESES = 8
"""Paths that are followed. Of 800 made paths with 10 and 30 % of wrong pairs 7 get a wrong sign, 18 with one
path alone; 4 move lengths by at most 0.06 %."""
RELATIVE_ERROR = 0.25
"""Of distances, besides their covariance: coherent tissue makes long distances too short, so that a misfit of
a quarter is no sign of turning back. A half of a person's sweep of bone folds with 0.1; without, 50 steps of
six made wobbles of 3 Hz get the wrong sign, 3 with it."""
TREND_MM = 0.3
"""Travel over which a direction is remembered: a few frames of a hand-held sweep. Without memory, or with one
that lasts, 50 steps of those wobbles get the wrong sign."""
TURNING_COST = 2.0
"""Squared deviations by which the planes must speak for turning back: hands turn back rarely. Without, 138
steps of those wobbles get the wrong sign."""
SAME_MM = 0.05
"""Paths that end this close to each other at all frames still of use are one."""


class Strangers(NamedTuple):
    """Pairs of uncorrelated frames, which therefore are not close together.

    Attributes
    ----------
    first, second : ndarray of int, shape (u,)
        The earlier and the later frame; sorted by the later.
    apart_mm : float
        How far their patches are from each other at least, RMS.
    width_mm : float
        Standard deviation of the lever arms of the slope, which adds to the distance in quadrature.
    """

    first: IntArray
    second: IntArray
    apart_mm: float
    width_mm: float


def likeliest_path(
    planes: PairPlanes,
    frames: int,
    strangers: Strangers,
    start: FloatArray | None = None,
) -> FloatArray:
    """Follow the most likely paths: elevational position and slope along x of one frame after the other.

    A frame is placed by its planes against earlier frames, of which the latest settles the direction. The
    sweep's first motion counts as positive. Frames that no pair places stay where the one before them is.

    Parameters
    ----------
    planes : PairPlanes
        Sorted by the second frame.
    frames : int
        Of the sweep.
    strangers : Strangers
    start : ndarray, shape (m, 2), optional
        Position and slope of the first m frames, which stay; of the first one zero.

    Returns
    -------
    ndarray, shape (n, 2)
        Position and slope of every frame on the best path.
    """
    rules = PathRules(HYPOTHESES, RELATIVE_ERROR, OUTLYING, TURNING_COST, TREND_MM, SAME_MM, *strangers[2:])
    path, every = np.zeros((frames, 2)), np.arange(frames + 1)
    start = path[:1] if start is None else start
    path[: len(start)] = start
    follow_paths(
        np.searchsorted(planes.second, every),
        np.ascontiguousarray(planes.first),
        np.ascontiguousarray(planes.coefficients[:, :2]),
        planes.sign_covariance,
        np.searchsorted(strangers.second, every),
        np.ascontiguousarray(strangers.first),
        rules,
        path,
        len(start),
    )
    return path


def on_path(planes: PairPlanes, path: FloatArray) -> PairPlanes:
    """Planes with the signs that agree best with a path of shape (n, 2)."""
    relative, moved = path[planes.second] - path[planes.first], planes.coefficients[:, :2]
    weight = np.linalg.inv(planes.sign_covariance)
    agreement = np.einsum("ei,eij,ej->e", relative, weight, moved)
    sign = np.where(agreement >= 0.0, 1.0, -1.0)
    return replace(planes, coefficients=planes.coefficients * sign[:, None])
