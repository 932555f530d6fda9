"""Problems and frame pairs of made correlations, one at a time or many, for tests of planes and paths."""

from types import SimpleNamespace

import numpy as np

from speckle3d.core.curves import TiltResponse
from speckle3d.core.grid import ImageGrid
from speckle3d.matching.patches import lay_patches
from speckle3d.matching.schedule import TrajectorySettings
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.planes import MotionProblem, PairPlanes, PlaneSettings, fully_developed, pair_planes

GRID = ImageGrid(vectors=127, samples=640, vector_pitch_mm=0.3, sample_spacing_mm=0.06)
PATCHES = lay_patches(GRID)
AT = PATCHES.centre_mm - GRID.centre_mm[:2]
"""Centres of the patches about the image's."""
TILT = TiltResponse(np.array([-9.0, 8.0]), np.array([2.0, 6.0]))
"""As a linear probe's: turning is about a point near the focus, some seven millimetres off at either end."""


def problem_of(curves, patches=PATCHES, grid=GRID, frames=2, **settings):
    return MotionProblem(
        curves, patches, grid.centre_mm, frames, PlaneSettings(**settings), TrajectorySettings()
    )


def table_of(rho, shift_mm=(0.0, 0.0), first=None, second=None):
    """Pairs of frames 0 and 1, or of others, with correlations of shape (e, p)."""
    rho = np.asarray(rho, np.float32)
    motion = np.tile([*shift_mm, 0.0], (len(rho), 1)), np.tile(1e-6 * np.eye(3), (len(rho), 1, 1))
    first = np.zeros(len(rho), int) if first is None else np.asarray(first)
    second = np.ones(len(rho), int) if second is None else np.asarray(second)
    return CorrelationTable(first, second, rho, *motion)


def fit_many(problem, rho, shift_mm=(0.0, 0.0), **priors):
    """Planes of pairs from correlations of shape (e, p), and which are determined."""
    models = fully_developed(rho.shape[1])
    return pair_planes(problem, table_of(rho, shift_mm), np.arange(len(rho)), models, **priors)


def fit(problem, rho, shift_mm=(0.0, 0.0), **priors):
    """Plane of one pair, from correlations of shape (p,); None if they determine none."""
    alone = {name: np.asarray(value)[None] for name, value in priors.items()}
    planes, has_plane = fit_many(problem, np.asarray(rho)[None], shift_mm, **alone)
    if not has_plane[0]:
        return None
    fields = {name: value[0] for name, value in vars(planes).items()}
    return SimpleNamespace(offset_mm=planes.offset_mm[0], **fields)


def from_coefficients(first, second, coefficients, covariance):
    """Planes given by their coefficients, (e, 3), and covariances, (e, 3, 3) or one for all."""
    coefficients = np.asarray(coefficients, float).reshape(-1, 3)
    pairs = len(coefficients)
    return PairPlanes(
        np.arange(pairs),
        np.broadcast_to(first, pairs),
        np.broadcast_to(second, pairs),
        coefficients,
        np.array(np.broadcast_to(covariance, (pairs, 3, 3)), float),
        np.ones((pairs, 1), bool),
        np.zeros(pairs),
    )
