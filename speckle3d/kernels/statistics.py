"""Sampling statistics of speckle's correlation; the same arithmetic for arrays and inside kernels."""

from __future__ import annotations

from typing import Any

INTERPOLATION = 0.003
"""Standard deviation that interpolation between samples leaves in a correlation."""


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
