"""A frame's spectrum to its intensity, and intensity over its local mean."""

from __future__ import annotations

import numpy as np
from numba import njit

from speckle3d.core.arrays import Float32Array, IntArray

_LEAST_MEAN = 1e-9
"""Of the largest mean, under which none is divided by."""
_TINY = float(np.finfo(np.float32).tiny)


@njit(cache=True, nogil=True, fastmath=False)
def place_band(spectrum: Float32Array, weights: Float32Array, runs: IntArray, out: Float32Array) -> None:
    """Fill `out` with the weighted bins of a band in their new places, and with zeros elsewhere.

    Real and imaginary parts come in turn everywhere.

    Parameters
    ----------
    spectrum, out : float32, shape (row, 2 * bins)
    weights : float32, shape (2 * b,)
        Of the band's bins, in the order of the runs; real, the imaginary parts are not looked at.
    runs : int64, shape (r, 3)
        First bin in `spectrum`, first in `out`, and count of bins that follow one another in both.
    """
    for row in range(out.shape[0]):
        out[row] = 0.0
        z, x = spectrum[row], out[row]
        done = 0
        for r in range(runs.shape[0]):
            first, to, count = runs[r, 0], runs[r, 1], runs[r, 2]
            for k in range(count):
                x[2 * (to + k)] = z[2 * (first + k)] * weights[2 * (done + k)]
                x[2 * (to + k) + 1] = z[2 * (first + k) + 1] * weights[2 * (done + k)]
            done += count


@njit(cache=True, nogil=True, fastmath={"contract"})
def place_band_of_real(
    spectrum: Float32Array, here: Float32Array, mirrored: Float32Array, runs: IntArray, out: Float32Array
) -> None:
    """Do as `place_band` for real rows that were transformed as half as many complex numbers.

    With Z the spectrum of the even samples plus i times the odd ones, h bins long, that of all is
    ``X[k] = here[k] * Z[k] + mirrored[k] * conj(Z[h - k])``.

    Parameters
    ----------
    here, mirrored : float32, shape (2 * b,)
        Factors of the band's bins, weights included.
    """
    bins = spectrum.shape[1] // 2
    for row in range(out.shape[0]):
        out[row] = 0.0
        done = 0
        for r in range(runs.shape[0]):
            first, to, count = runs[r, 0], runs[r, 1], runs[r, 2]
            z = spectrum[row, 2 * first : 2 * (first + count)]
            mirror = spectrum[row, 2 * (bins - first - count + 1) : 2 * (bins - first + 1)]
            x = out[row, 2 * to : 2 * (to + count)]
            a, b = here[2 * done : 2 * (done + count)], mirrored[2 * done : 2 * (done + count)]
            for k in range(count):
                j = count - 1 - k
                real, imaginary = mirror[2 * j], -mirror[2 * j + 1]
                x[2 * k] = (
                    z[2 * k] * a[2 * k]
                    - z[2 * k + 1] * a[2 * k + 1]
                    + (real * b[2 * k] - imaginary * b[2 * k + 1])
                )
                x[2 * k + 1] = (
                    z[2 * k] * a[2 * k + 1]
                    + z[2 * k + 1] * a[2 * k]
                    + (real * b[2 * k + 1] + imaginary * b[2 * k])
                )
            done += count


@njit(cache=True, nogil=True, fastmath=False)
def squared_magnitude(analytic: Float32Array, out: Float32Array) -> None:
    """Fill `out`, shape (row, n), from real and imaginary parts in turn, shape (row, 2 * n or more)."""
    for row in range(out.shape[0]):
        source, target = analytic[row], out[row]
        for k in range(target.size):
            target[k] = source[2 * k] * source[2 * k] + source[2 * k + 1] * source[2 * k + 1]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def local_mean(image: Float32Array, half: IntArray, out: Float32Array) -> float:
    """Fill `out` with the mean over a window about each sample, edges repeated, and return the floor.

    Sums run in double precision: over vectors from row to row, along a vector as differences of sums from its
    start.

    Parameters
    ----------
    image, out : float32, shape (vector, sample)
    half : int64, shape (2,)
        Vectors and samples on either side in the window.

    Returns
    -------
    float
        Least mean to divide by; NaN where any mean is not a number.
    """
    rows, samples = image.shape
    wide, high = 2 * half[0] + 1, 2 * half[1] + 1
    lateral, largest = np.zeros(samples), np.zeros(samples, np.float32)
    # Sums from the start of a vector whose ends are repeated, and the same from a window later.
    upto = np.zeros(samples + high)
    later = upto[high:]
    scale = 1.0 / (wide * high)
    not_finite = 0.0
    for v in range(-half[0], half[0] + 1):
        entering = image[min(max(v, 0), rows - 1)]
        for k in range(samples):
            lateral[k] += entering[k]
    for row in range(rows):
        total = 0.0
        before, inside, behind = upto[1:], upto[1 + half[1] :], upto[1 + half[1] + samples :]
        for k in range(half[1]):
            total += lateral[0]
            before[k] = total
        for k in range(samples):
            total += lateral[k]
            inside[k] = total
        for k in range(half[1]):
            total += lateral[samples - 1]
            behind[k] = total
        not_finite += 0.0 * total
        target = out[row]
        for k in range(samples):
            mean = np.float32((later[k] - upto[k]) * scale)
            target[k] = mean
            largest[k] = mean if mean > largest[k] else largest[k]
        entering = image[min(row + half[0] + 1, rows - 1)]
        leaving = image[max(row - half[0], 0)]
        for k in range(samples):
            lateral[k] += entering[k] - np.float64(leaving[k])
    most = 0.0
    for k in range(samples):
        most = max(most, float(largest[k]))
    return _LEAST_MEAN * most + _TINY + not_finite


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def equalise_echo(
    analytic: Float32Array,
    intensity: Float32Array,
    mean: Float32Array,
    floor: float,
    image: Float32Array,
    parts: Float32Array,
) -> None:
    """Fill `image` with intensity over its local mean, `parts` with the echo over the mean's root.

    Parameters
    ----------
    analytic : float32, shape (vector, 2 * sample)
        Real and imaginary parts in turn.
    intensity, mean, image : float32, shape (vector, sample)
        The mean is `local_mean`'s, as is `floor`.
    parts : float32, shape (2, vector, sample)
    """
    least = np.float32(floor)
    for row in range(image.shape[0]):
        echo, source, under = analytic[row], intensity[row], mean[row]
        ratio, real, imaginary = image[row], parts[0, row], parts[1, row]
        for k in range(source.size):
            gain = np.float32(1.0) / (under[k] if under[k] > least else least)
            ratio[k] = source[k] * gain
            gain = np.sqrt(gain)
            real[k] = echo[2 * k] * gain
            imaginary[k] = echo[2 * k + 1] * gain
