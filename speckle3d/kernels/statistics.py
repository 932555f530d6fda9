"""Sampling statistics of speckle's correlation; the same arithmetic for arrays and inside kernels."""

from typing import Any, NamedTuple

from numba.extending import register_jitable

from speckle3d.core.arrays import FloatArray

INTERPOLATION = 0.003
"""Standard deviation that interpolation between samples leaves in a correlation."""


class PatchCurves(NamedTuple):
    """Fully developed curve at every patch, as kernels take it.

    Attributes
    ----------
    amplitude : float64, shape (p, m)
        sqrt(rho_F) on a grid of `step_mm`.
    step_mm : float
    cells : float64, shape (p,)
        Independent speckle cells in a patch.
    of_echo : bool
        Whether the correlation is the complex echo's.
    """

    amplitude: FloatArray
    step_mm: float
    cells: FloatArray
    of_echo: bool


@register_jitable(fastmath=False, error_model="numpy")
def correlation_variance(rho: Any, cells: Any, of_echo: bool) -> Any:
    """Variance of a correlation over so many independent cells.

    Parameters
    ----------
    rho : float or ndarray
        Of intensity, or the squared magnitude of the complex echo's, which for speckle is the same.
    cells : float or ndarray
    of_echo : bool
        The latter: 2 rho (1 - rho)^2 / N and what is left of it at rho = 0, the Cramer-Rao bound for two
        complex Gaussian echoes of unknown power. Else (1 - rho^2)^2 / N.
    """
    left = (1.0 - rho) * (1.0 - rho) / cells
    if of_echo:
        return left * (2.0 * rho + 1.0 / cells)
    return left * (1.0 + rho) * (1.0 + rho)
