"""Mirror solutions: several sets of angles and pixel sizes are one calibration; one of them is canonical."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import FloatArray


def wrapped(angles_rad: npt.ArrayLike) -> FloatArray:
    """Angles brought into (-pi, pi]."""
    return np.asarray(np.pi - np.mod(np.pi - np.asarray(angles_rad, dtype=float), 2 * np.pi))


def canonical(angles_rad: npt.ArrayLike, pixel_mm: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Bring fixed angles and pixel sizes into the form with positive sizes and |beta| <= pi / 2.

    The calibration matrix, ``rotation @ diag(s_x, s_y, 0)``, stays what it is.

    Parameters
    ----------
    angles_rad : array_like, shape (3,)
        alpha, beta, gamma.
    pixel_mm : array_like, shape (2,)
        s_x, s_y.

    References
    ----------
    .. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, appendix C. Its second step adds pi to beta, which is
       another rotation; beta is reflected here, which is the same one.
    """
    alpha, beta, gamma = (float(a) for a in wrapped(angles_rad))
    s_x, s_y = (float(s) for s in np.asarray(pixel_mm, dtype=float))
    if abs(beta) > np.pi / 2:
        alpha, beta, gamma = alpha + np.pi, np.copysign(np.pi, beta) - beta, gamma + np.pi
    if s_y < 0:
        gamma, s_y = gamma + np.pi, -s_y
    if s_x < 0:
        alpha, beta, gamma, s_x = alpha + np.pi, -beta, np.pi - gamma, -s_x
    return np.array([*wrapped([alpha, beta, gamma])]), np.array([s_x, s_y])
