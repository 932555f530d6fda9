"""Rayleigh-Sommerfeld sums for a linear array with an elevational lens."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from speckle3d.core.arrays import ComplexArray, FloatArray


@njit(cache=True, parallel=True, fastmath=True)
def line_field(
    depth_mm: FloatArray,
    lateral_mm: FloatArray,
    elevation_mm: FloatArray,
    strip_mm: FloatArray,
    lens_mm: FloatArray,
    wavenumbers_rad_mm: FloatArray,
    out: ComplexArray,
) -> None:
    """Fill ``out[y, x, z, k]`` with the field of one elevational line of strips behind the lens.

    ``lens_mm`` is the path that the lens adds to each strip. The wavenumbers must be evenly spaced: the
    phasor of one node follows from its neighbour's by a product, so a strip costs two exponentials.
    """
    nodes = wavenumbers_rad_mm.shape[0]
    first = wavenumbers_rad_mm[0]
    step = wavenumbers_rad_mm[1] - first if nodes > 1 else 0.0
    for iy in prange(depth_mm.shape[0]):
        y = depth_mm[iy]
        for ix in range(lateral_mm.shape[0]):
            xy2 = y * y + lateral_mm[ix] ** 2
            for iz in range(elevation_mm.shape[0]):
                for k in range(nodes):
                    out[iy, ix, iz, k] = 0.0
                for s in range(strip_mm.shape[0]):
                    r = np.sqrt(xy2 + (elevation_mm[iz] - strip_mm[s]) ** 2)
                    path = r + lens_mm[s]
                    # Obliquity y/r and spreading 1/r of a source in a pressure-release plane.
                    weight = y / (r * r)
                    phasor = weight * (np.cos(first * path) - 1j * np.sin(first * path))
                    turn = np.cos(step * path) - 1j * np.sin(step * path)
                    for k in range(nodes):
                        out[iy, ix, iz, k] += phasor
                        phasor *= turn


@njit(cache=True, parallel=True, fastmath=True)
def two_way_field(
    line: ComplexArray,
    source_mm: FloatArray,
    lateral_step_mm: float,
    transmit: ComplexArray,
    receive: ComplexArray,
    out: ComplexArray,
) -> None:
    """Fill ``out[y, x, z, k]`` with transmit field times receive field.

    ``line[y, j, z, k]`` is the field of a line source at lateral distance ``(j + 1/2) * lateral_step_mm``;
    every source lies half a step off the lateral grid, so that all its distances are in the table.
    ``transmit[y, s, k]`` and ``receive[y, s, k]`` weigh and delay source ``s``.
    """
    ny, nx, nz, nodes = out.shape
    for iy in prange(ny):
        sent = np.empty((nz, nodes), dtype=np.complex128)
        heard = np.empty((nz, nodes), dtype=np.complex128)
        for ix in range(nx):
            sent[:] = 0.0
            heard[:] = 0.0
            for s in range(source_mm.shape[0]):
                j = int(abs(ix * lateral_step_mm - source_mm[s]) / lateral_step_mm)
                for iz in range(nz):
                    for k in range(nodes):
                        sent[iz, k] += transmit[iy, s, k] * line[iy, j, iz, k]
                        heard[iz, k] += receive[iy, s, k] * line[iy, j, iz, k]
            for iz in range(nz):
                for k in range(nodes):
                    out[iy, ix, iz, k] = sent[iz, k] * heard[iz, k]
