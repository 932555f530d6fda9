"""Errors where the sum of squares is no parabola: the profile of the least certain displacement.

Standard errors come from the curvature at the answer. Where a motion is nearly missing, the sum of squares
lies in a bent valley and rises more slowly, far from the answer, than its curvature there says. The least
certain displacement is therefore held away from the answer, all else is solved for anew, and the covariance
is widened until it says how far the data let it go.

References
----------
.. [1] D. M. Bates and D. G. Watts, "Nonlinear regression analysis and its applications", Wiley, 1988, 6.1
   (profile t).
"""

from __future__ import annotations

import numpy as np

from calibration.chain import CHAIN, Chain, ImagePoints, Phantom
from calibration.equations import BareChain, Equations, columns_of
from calibration.near import corners_moved
from speckle3d.core.arrays import FloatArray
from speckle3d.core.leastsquares import levenberg_marquardt

_FAR = 2.0
"""Standard errors at which the profile is taken."""

_WIDENING, _WIDEST = 1.5, 12.0
"""Step and end of the search for the place where the sum of squares has risen as the curvature promised."""

_TOLERANCE = 1e-4
"""Relative; a rise is wanted to a few percent."""


def widened(
    points: ImagePoints,
    phantom: Phantom,
    chain: Chain,
    free: tuple[str, ...],
    covariance: FloatArray,
) -> FloatArray:
    """Widen a covariance along the least certain displacement until it covers the profile.

    Parameters
    ----------
    points : ImagePoints
        Those used.
    chain : Chain
        The solution.
    free : tuple of str, length p
    covariance : ndarray, shape (p, p)
        In frames that lie on the image and on the phantom.

    Returns
    -------
    ndarray, shape (p, p)
        Never less than `covariance`.
    """
    least_certain = _least_certain(points, phantom, chain, free, covariance)
    along = covariance @ least_certain
    variance = float(least_certain @ along)
    if not np.isfinite(variance) or variance <= 0:
        return covariance
    step = along / np.sqrt(variance)
    rise = _Rise(points, phantom, chain, free, step)
    wide = max(_reach(rise, sign) for sign in (-1.0, 1.0))
    return np.asarray(covariance + (wide**2 - 1.0) * np.outer(step, step))


class _Rise:
    """Rise of the sum of squares with one displacement held and all else solved for.

    That of images that agree with the answer: its derivative there is zero, whatever the errors are.
    """

    def __init__(
        self,
        points: ImagePoints,
        phantom: Phantom,
        chain: Chain,
        free: tuple[str, ...],
        step: FloatArray,
    ) -> None:
        bare, columns = BareChain.of(chain), columns_of(free)
        near, origin = Equations.of(points, phantom).near(bare), bare.on_image

        def at(x: FloatArray) -> tuple[FloatArray, FloatArray]:
            full = origin.copy()
            full[columns] += x
            return near.derivatives(full, columns)

        self._at, self._step = at, step
        self._here, jacobian = at(np.zeros(len(free)))
        scale = np.linalg.norm(jacobian, axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        # All directions but the one held, in the unit of each parameter.
        self._others = np.linalg.svd((step * scale)[None])[2][1:].T / scale[:, None]
        pushed = jacobian @ step
        left = pushed - jacobian @ self._others @ np.linalg.lstsq(jacobian @ self._others, pushed)[0]
        self.promised = float(left @ left)
        """Rise at one standard error, from the curvature at the answer."""

    def __call__(self, errors: float) -> float:
        """Rise at so many standard errors."""

        def residuals(y: FloatArray) -> FloatArray:
            return self._at(errors * self._step + self._others @ y)[0] - self._here

        def jacobian(y: FloatArray) -> FloatArray:
            return self._at(errors * self._step + self._others @ y)[1] @ self._others

        fit = levenberg_marquardt(residuals, np.zeros(self._others.shape[1]), jacobian, tolerance=_TOLERANCE)
        return float(fit.residuals @ fit.residuals)


def _reach(rise: _Rise, sign: float) -> float:
    """How many times wider than the curvature promises, at least once."""
    wanted = _FAR**2 * rise.promised
    wide = 1.0
    before = rise(sign * _FAR)
    while before < wanted and wide < _WIDEST:
        wider = wide * _WIDENING
        after = rise(sign * _FAR * wider)
        if after >= wanted:
            share = (wanted - before) / (after - before)
            return wide + max(0.0, share) * (wider - wide)
        wide, before = wider, after
    return wide


def _least_certain(
    points: ImagePoints,
    phantom: Phantom,
    chain: Chain,
    free: tuple[str, ...],
    covariance: FloatArray,
) -> FloatArray:
    """Derivatives, by the free parameters, of the least certain angle, or of the worst corner's shift."""
    columns = [CHAIN.index(name) for name in free]
    if phantom.seen_as == "direction":
        moved = np.eye(len(CHAIN))[None, 5:8]
    else:
        moved = corners_moved(chain, points)
    each = moved[:, :, columns]
    spread = np.einsum("kip,pq,kjq->kij", each, covariance, each)
    sizes, axes = np.linalg.eigh(spread)
    worst = int(np.argmax(sizes[:, -1]))
    return np.asarray(axes[worst, :, -1] @ each[worst])
