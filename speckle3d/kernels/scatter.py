"""Summing the echoes of point scatterers into the baseband of each vector."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray

_SUMS = {"reassoc", "contract", "arcp"}
_TURNS = 8192
_TWO_PI = 2.0 * np.pi
_PHASORS = np.exp(-1j * _TWO_PI * np.arange(_TURNS) / _TURNS).astype(np.complex64)


class BeamField(NamedTuple):
    """The two-way beam of a vector, symmetric to either side and in elevation.

    Attributes
    ----------
    field : float32, shape (y, z, x, nodes * 2)
        Residual amplitude, real and imaginary parts in turn.
    reach : int64, shape (y, x)
        How many elevational steps the beam reaches; beyond that the field is left out.
    curvature_per_mm : float64, shape (y, 2)
        Path curvature, lateral and elevational: the echo comes from depth ``y + kx x^2 + kz z^2``.
    grid : float64, shape (4,)
        First depth, depth step, lateral step, elevational step, mm.
    """

    field: Float32Array
    reach: IntArray
    curvature_per_mm: FloatArray
    grid: FloatArray


class EchoGrid(NamedTuple):
    """Where echoes are summed: depth of the first sample and per sample, and the carrier's cycles, per mm."""

    first_depth_mm: float
    sample_mm: float
    cycles_per_mm: float


@njit(cache=True, inline="always", fastmath=_SUMS)
def _unit_phasor(cycles: float) -> Any:
    """``exp(-2 pi i cycles)`` to 1e-7: the nearest tabulated phasor, turned by the small angle to it."""
    place = (cycles - np.floor(cycles)) * _TURNS
    nearest = int(place + 0.5)
    angle = np.float32((place - nearest) * (_TWO_PI / _TURNS))
    return _PHASORS[nearest & (_TURNS - 1)] * np.complex64(complex(1.0, -angle))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS)
def scatter_echoes(
    position_mm: FloatArray,
    strength: Float32Array,
    vectors: FloatArray,
    image_from_medium: FloatArray,
    beam: BeamField,
    echoes: EchoGrid,
    out: Float32Array,
) -> None:
    """Add each scatterer's echo to ``out[vector, sample]`` of every vector that it lies near.

    Fastest if neighbours in the list are of similar depth: the beam's table is long.

    Parameters
    ----------
    position_mm, strength : ndarray, shape (n, 3) and (n,)
        Scatterers in the medium.
    vectors : float64, shape (v, 4)
        Where each begins, x and y, and its direction, towards growing x from one to the next.
    image_from_medium : float64, shape (4, 4)
    out : float32, shape (v, sample, nodes * 2)
        Real and imaginary parts in turn.
    """
    field, reach, curvature_per_mm, grid = beam
    first_depth_mm, sample_mm, cycles_per_mm = echoes
    ny, nz, nx, parts = field.shape
    row, plane = nx * parts, nz * nx * parts
    flat, value = field.reshape(field.size), np.empty(2 * parts, np.float32)
    t, one = image_from_medium, np.float32(1.0)
    for j in range(position_mm.shape[0]):
        a, b, c = position_mm[j, 0], position_mm[j, 1], position_mm[j, 2]
        z = t[2, 0] * a + t[2, 1] * b + t[2, 2] * c + t[2, 3]
        fz = abs(z) / grid[3]
        iz = int(fz)
        if iz >= nz - 1:
            continue
        x = t[0, 0] * a + t[0, 1] * b + t[0, 2] * c + t[0, 3]
        y = t[1, 0] * a + t[1, 1] * b + t[1, 2] * c + t[1, 3]
        wz = np.float32(fz - iz)
        # The first vector that passes the scatterer on its right, by bisection.
        left, right = 0, out.shape[0]
        while left < right:
            n = (left + right) // 2
            if (x - vectors[n, 0]) * vectors[n, 3] > (y - vectors[n, 1]) * vectors[n, 2]:
                left = n + 1
            else:
                right = n
        for turn in (-1, 1):
            n = left - (turn < 0)
            while 0 <= n < out.shape[0]:
                dx, dy, sine, cosine = x - vectors[n, 0], y - vectors[n, 1], vectors[n, 2], vectors[n, 3]
                line = out[n]
                n += turn
                depth_mm, across_mm = dx * sine + dy * cosine, abs(dx * cosine - dy * sine)
                fy, fx = (depth_mm - grid[0]) / grid[1], across_mm / grid[2]
                iy, ix = int(np.floor(fy)), int(fx)
                if ix >= nx - 1:
                    break
                if iy < 0 or iy >= ny - 1 or iz >= reach[iy, ix]:
                    continue
                part = fy - iy
                kx = (1.0 - part) * curvature_per_mm[iy, 0] + part * curvature_per_mm[iy + 1, 0]
                kz = (1.0 - part) * curvature_per_mm[iy, 1] + part * curvature_per_mm[iy + 1, 1]
                echo_mm = depth_mm + kz * z * z + kx * across_mm * across_mm
                at = (echo_mm - first_depth_mm) / sample_mm
                sample = int(np.floor(at))
                if sample < 0 or sample >= out.shape[1] - 1:
                    continue
                wy, wx, late = np.float32(part), np.float32(fx - ix), np.float32(at - sample)
                w00, w01, w10, w11 = (one - wy) * (one - wz), (one - wy) * wz, wy * (one - wz), wy * wz
                # Slices, not offsets: an index that may be negative keeps the compiler from using vector
                # instructions.
                corner = ((iy * nz + iz) * nx + ix) * parts
                f00, f01 = flat[corner:][: 2 * parts], flat[corner + row :][: 2 * parts]
                f10, f11 = flat[corner + plane :][: 2 * parts], flat[corner + plane + row :][: 2 * parts]
                for q in range(2 * parts):
                    value[q] = w00 * f00[q] + w01 * f01[q] + w10 * f10[q] + w11 * f11[q]
                # The carrier's phase is exact; only the slow baseband is split between two samples.
                carrier = strength[j] * _unit_phasor(cycles_per_mm * echo_mm)
                for k in range(0, parts, 2):
                    real = (one - wx) * value[k] + wx * value[parts + k]
                    imaginary = (one - wx) * value[k + 1] + wx * value[parts + k + 1]
                    re = carrier.real * real - carrier.imag * imaginary
                    im = carrier.real * imaginary + carrier.imag * real
                    line[sample, k] += (one - late) * re
                    line[sample, k + 1] += (one - late) * im
                    line[sample + 1, k] += late * re
                    line[sample + 1, k + 1] += late * im
