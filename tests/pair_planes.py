"""Frame pairs one at a time, for tests that look at single ones."""

from types import SimpleNamespace

import numpy as np

from speckle3d.motion.planes import PairPlanes


def pair(planes, k=0):
    """One of several planes; None if its patches do not determine it."""
    if not planes.determined[k]:
        return None
    one = planes[[k]]
    offset, slope_x, slope_y = one.coefficients[0]
    fields = {name: value[0] for name, value in vars(one).items()}
    return SimpleNamespace(offset_mm=offset, slope_x=slope_x, slope_y=slope_y, **fields)


def fit(fitter, rho, moved_mm, coherence=None, subset=None, slopes=None, start_mm=None, either_side=True):
    """Plane of one pair, from correlations of shape (p,); None if they determine none."""
    alone = [None if x is None else np.asarray(x)[None] for x in (subset, slopes, start_mm, either_side)]
    if alone[1] is not None:
        alone[1] = alone[1].astype(float)
    pairs = np.asarray(rho, np.float32)[None], np.asarray(moved_mm)[None]
    return pair(fitter.fit(*pairs, coherence, np.zeros(1), *alone))


def made(coefficients, covariance, sigma_mm=1.0, patches=1):
    """Planes given by their coefficients, (e, 3), and covariances, (e, 3, 3) or one for all."""
    coefficients = np.asarray(coefficients, float).reshape(-1, 3)
    shape = len(coefficients), patches
    return PairPlanes(
        coefficients,
        np.array(np.broadcast_to(covariance, (len(coefficients), 3, 3)), float),
        np.ones(shape, bool),
        np.zeros(shape),
        np.full(shape, sigma_mm),
        np.ones(len(coefficients), bool),
    )
