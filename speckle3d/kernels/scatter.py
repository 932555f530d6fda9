"""Summing the echoes of point scatterers into the baseband of each vector."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from speckle3d.core.arrays import Complex64Array, Float32Array, FloatArray, IntArray

_BINS_PER_MM = 16.0
_TURNS = 8192
_TWO_PI = 2.0 * np.pi
_PHASORS = np.exp(-1j * _TWO_PI * np.arange(_TURNS) / _TURNS).astype(np.complex64)


@njit(cache=True, inline="always")
def _unit_phasor(cycles: float) -> Any:
    """``exp(-2 pi i cycles)`` to 1e-7: the nearest tabulated phasor, turned by the small rest."""
    scaled = (cycles - np.floor(cycles)) * _TURNS
    nearest = int(scaled + 0.5)
    rest = np.float32((scaled - nearest) * (_TWO_PI / _TURNS))
    return _PHASORS[nearest & (_TURNS - 1)] * np.complex64(complex(1.0, -rest))


@njit(cache=True, parallel=True, fastmath=True)
def scatter_echoes(
    position_mm: FloatArray,
    amplitude: Float32Array,
    cell_start: IntArray,
    first_cell: IntArray,
    last_cell: IntArray,
    vector_mm: FloatArray,
    field: Complex64Array,
    reach: IntArray,
    curvature_per_mm: FloatArray,
    grid: FloatArray,
    first_depth_mm: float,
    sample_mm: float,
    cycles_per_mm: float,
    out: Complex64Array,
) -> None:
    """Add each scatterer's echo to ``out[vector, sample, node]`` of every vector that it lies near.

    Parameters
    ----------
    position_mm, amplitude : ndarray, shape (n, 3) and (n,)
        In the image frame, sorted by lateral cell.
    cell_start : ndarray, shape (cells + 1,)
        First scatterer of each lateral cell; vector ``v`` looks at cells ``first_cell[v]`` up to, not
        including, ``last_cell[v]``.
    field : ndarray, shape (y, x, z, nodes)
        Two-way residual amplitude; `grid` is (first depth, depth step, lateral step, elevational step).
    reach : ndarray, shape (y, x)
        How many elevational steps the beam reaches; beyond that the field is left out.
    curvature_per_mm : ndarray, shape (y, 2)
        Path curvature, lateral and elevational: the echo comes from depth ``y + kx x^2 + kz z^2``.
    sample_mm, cycles_per_mm : float
        Depth per sample of `out`, and carrier cycles per mm of depth.
    """
    ny, nx, _, nodes = field.shape
    samples = out.shape[1]
    for v in prange(vector_mm.shape[0]):
        value = np.empty(nodes, dtype=np.complex64)
        for j in range(cell_start[first_cell[v]], cell_start[last_cell[v]]):
            fx = abs(position_mm[j, 0] - vector_mm[v]) / grid[2]
            ix = int(fx)
            fy = (position_mm[j, 1] - grid[0]) / grid[1]
            iy = int(np.floor(fy))
            if ix >= nx - 1 or iy < 0 or iy >= ny - 1:
                continue
            fz = abs(position_mm[j, 2]) / grid[3]
            iz = int(fz)
            if iz >= reach[iy, ix]:
                continue
            wx, wy, wz = np.float32(fx - ix), np.float32(fy - iy), np.float32(fz - iz)
            x2 = (fx * grid[2]) ** 2
            z2 = position_mm[j, 2] ** 2
            kx = (1.0 - wy) * curvature_per_mm[iy, 0] + wy * curvature_per_mm[iy + 1, 0]
            kz = (1.0 - wy) * curvature_per_mm[iy, 1] + wy * curvature_per_mm[iy + 1, 1]
            echo_mm = position_mm[j, 1] + kx * x2 + kz * z2
            at = (echo_mm - first_depth_mm) / sample_mm
            n = int(np.floor(at))
            if n < 0 or n >= samples - 1:
                continue
            one = np.float32(1.0)
            w000 = (one - wy) * (one - wx) * (one - wz)
            w001 = (one - wy) * (one - wx) * wz
            w010 = (one - wy) * wx * (one - wz)
            w011 = (one - wy) * wx * wz
            w100 = wy * (one - wx) * (one - wz)
            w101 = wy * (one - wx) * wz
            w110 = wy * wx * (one - wz)
            w111 = wy * wx * wz
            carrier = amplitude[j] * _unit_phasor(cycles_per_mm * echo_mm)
            late = np.float32(at - n)
            for k in range(nodes):
                value[k] = carrier * (
                    w000 * field[iy, ix, iz, k]
                    + w001 * field[iy, ix, iz + 1, k]
                    + w010 * field[iy, ix + 1, iz, k]
                    + w011 * field[iy, ix + 1, iz + 1, k]
                    + w100 * field[iy + 1, ix, iz, k]
                    + w101 * field[iy + 1, ix, iz + 1, k]
                    + w110 * field[iy + 1, ix + 1, iz, k]
                    + w111 * field[iy + 1, ix + 1, iz + 1, k]
                )
            # The carrier's phase is exact; only the slow baseband is split between two samples.
            for k in range(nodes):
                out[v, n, k] += (one - late) * value[k]
                out[v, n + 1, k] += late * value[k]


@njit(cache=True)
def gather_near(
    position_mm: FloatArray,
    strength: Float32Array,
    image_from_medium: FloatArray,
    lateral_mm: FloatArray,
    depth_mm: FloatArray,
    thickness_mm: FloatArray,
    out_position_mm: FloatArray,
    out_strength: Float32Array,
    filled: int,
) -> int:
    """Append the scatterers within the beam's reach, moved into the image frame; return how many there are.

    ``lateral_mm`` holds the two lateral limits, ``depth_mm`` first depth and step of ``thickness_mm``.
    """
    m = image_from_medium
    last = thickness_mm.shape[0] - 1
    for j in range(position_mm.shape[0]):
        a, b, c = position_mm[j, 0], position_mm[j, 1], position_mm[j, 2]
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
        row = int(np.floor((y - depth_mm[0]) / depth_mm[1]))
        if row < 0 or row >= last or x <= lateral_mm[0] or x >= lateral_mm[1]:
            continue
        if abs(z) >= thickness_mm[row]:
            continue
        out_position_mm[filled, 0] = x
        out_position_mm[filled, 1] = y
        out_position_mm[filled, 2] = z
        out_strength[filled] = strength[j]
        filled += 1
    return filled


@njit(cache=True)
def sort_into_cells(
    position_mm: FloatArray,
    strength: Float32Array,
    left_mm: float,
    cell_mm: float,
    deep_mm: float,
    cell_start: IntArray,
    out_position_mm: FloatArray,
    out_strength: Float32Array,
) -> None:
    """Sort by lateral cell and, within it, by depth bin, so that table and vector stay in cache.

    Fills ``cell_start``, shape (cells + 1,), with the first scatterer of each lateral cell. All scatterers
    must lie inside the cells and between zero and ``deep_mm``.
    """
    bins = int(deep_mm * _BINS_PER_MM) + 1
    cells = cell_start.shape[0] - 1
    count = np.zeros(cells * bins + 1, dtype=np.int64)
    n = position_mm.shape[0]
    cell = np.empty(n, dtype=np.int64)
    for j in range(n):
        cell[j] = int((position_mm[j, 0] - left_mm) / cell_mm) * bins
        cell[j] += int(position_mm[j, 1] * _BINS_PER_MM)
        count[cell[j] + 1] += 1
    for i in range(1, count.shape[0]):
        count[i] += count[i - 1]
    for i in range(cells + 1):
        cell_start[i] = count[i * bins]
    for j in range(n):
        at = count[cell[j]]
        count[cell[j]] += 1
        out_position_mm[at] = position_mm[j]
        out_strength[at] = strength[j]
