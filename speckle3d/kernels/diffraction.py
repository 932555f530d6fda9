"""Field of a lens over elevation, as a line source sends it, at evenly spaced wavenumbers."""

from math import factorial

import numpy as np
from numba import njit
from numba.extending import register_jitable

from speckle3d.core.arrays import FloatArray

_TURNS = 2.0 / np.pi
_SERIES = tuple(((1 - n % 4) / factorial(n + 1), (1 - n % 4) / factorial(n)) for n in range(14, 0, -2))
"""Taylor's coefficients of sine and cosine: within an eighth of a turn the next terms are 2e-17."""
_QUARTER, _QUARTER_REST = 1.5707963267948966, 6.123233995736766e-17
"""A right angle, and what double precision leaves of it."""


@register_jitable(fastmath=False, error_model="numpy")
def _cosine_and_sine(angle: float) -> tuple[float, float]:
    """Cosine and sine to a few rounding errors, without a branch, for vectorised loops.

    Taylor's series within an eighth of a turn, then the quadrant.
    """
    quarters = np.rint(angle * _TURNS)
    x = (angle - quarters * _QUARTER) - quarters * _QUARTER_REST
    z = x * x
    s, c = 0.0, 0.0
    for odd, even in _SERIES:
        s, c = odd + z * s, even + z * c
    s, c = x + x * z * s, 1.0 + z * c
    turned = quarters - 4.0 * np.floor(0.25 * quarters)
    across = turned == 1.0 or turned == 3.0
    cosine, sine = (s, c) if across else (c, s)
    return -cosine if turned == 1.0 or turned == 2.0 else cosine, -sine if turned >= 2.0 else sine


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def lens_fields(
    distance_mm: FloatArray,
    elevation_mm: FloatArray,
    strip_mm: FloatArray,
    delay_mm: FloatArray,
    wavenumber_per_mm: FloatArray,
    order: int,
    first: int,
    stop: int,
    out: FloatArray,
) -> None:
    """Sum ``exp(-i k (path + delay)) / path**order`` over a lens' strips, at some of the distances.

    Parameters
    ----------
    distance_mm : float64, shape (y,)
        From the lens.
    elevation_mm : float64, shape (z,)
    strip_mm, delay_mm : float64, shape (s,)
        Elevation of the lens' strips, and what their delays are worth.
    wavenumber_per_mm : float64, shape (f,)
        Evenly spaced.
    order : int
        1, or 2.
    first, stop : int
        Distances that are worked on.
    out : float64, shape (y, f, z, 2)
        Real and imaginary parts.
    """
    strips, nodes = strip_mm.size, wavenumber_per_mm.size
    lowest, step = wavenumber_per_mm[0], wavenumber_per_mm[1] - wavenumber_per_mm[0]
    real, imaginary = np.empty(strips), np.empty(strips)
    turn_real, turn_imaginary = np.empty(strips), np.empty(strips)
    for y in range(first, stop):
        for z in range(elevation_mm.size):
            for s in range(strips):
                across = elevation_mm[z] - strip_mm[s]
                path = np.sqrt(distance_mm[y] * distance_mm[y] + across * across)
                c, sine = _cosine_and_sine(lowest * (path + delay_mm[s]))
                size = 1.0 / (path if order == 1 else path * path)
                real[s], imaginary[s] = size * c, -size * sine
                c, sine = _cosine_and_sine(step * (path + delay_mm[s]))
                turn_real[s], turn_imaginary[s] = c, -sine
            for f in range(nodes):
                total, total_imaginary = 0.0, 0.0
                for s in range(strips):
                    a, b = real[s], imaginary[s]
                    total += a
                    total_imaginary += b
                    real[s] = a * turn_real[s] - b * turn_imaginary[s]
                    imaginary[s] = a * turn_imaginary[s] + b * turn_real[s]
                out[y, f, z, 0], out[y, f, z, 1] = total, total_imaginary
