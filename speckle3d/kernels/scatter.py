"""Summing the echoes of point scatterers into the baseband of each vector."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange

from speckle3d.core.arrays import Complex64Array, Float32Array, FloatArray, IntArray

_BINS_PER_MM = 16.0
_TURNS = 8192
_TWO_PI = 2.0 * np.pi
_PHASORS = np.exp(-1j * _TWO_PI * np.arange(_TURNS) / _TURNS).astype(np.complex64)


class CellOrder(NamedTuple):
    """Scatterers in the image frame, sorted by lateral cell.

    Attributes
    ----------
    position_mm, strength : ndarray, shape (n, 3) and (n,)
    start : ndarray, shape (cells + 1,)
        First scatterer of each lateral cell.
    """

    position_mm: FloatArray
    strength: Float32Array
    start: IntArray


class Vectors(NamedTuple):
    """Lateral position of each vector, shape (v,), and its cells: `first` up to, not including, `last`."""

    lateral_mm: FloatArray
    first: IntArray
    last: IntArray


class FieldTable(NamedTuple):
    """The two-way beam.

    Attributes
    ----------
    field : ndarray, shape (y, x, z, nodes)
        Two-way residual amplitude.
    reach : ndarray, shape (y, x)
        How many elevational steps the beam reaches; beyond that the field is left out.
    curvature_per_mm : ndarray, shape (y, 2)
        Path curvature, lateral and elevational: the echo comes from depth ``y + kx x^2 + kz z^2``.
    grid : ndarray, shape (4,)
        First depth, depth step, lateral step, elevational step, mm.
    """

    field: Complex64Array
    reach: IntArray
    curvature_per_mm: FloatArray
    grid: FloatArray


class BeamLimits(NamedTuple):
    """How far from the image the beam reaches.

    Attributes
    ----------
    lateral_mm : ndarray, shape (2,)
    depth_mm : ndarray, shape (2,)
        First depth and step of `thickness_mm`.
    thickness_mm : ndarray, shape (y,)
    """

    lateral_mm: FloatArray
    depth_mm: FloatArray
    thickness_mm: FloatArray


@njit(cache=True, inline="always")
def _unit_phasor(cycles: float) -> Any:
    """``exp(-2 pi i cycles)`` to 1e-7: the nearest tabulated phasor, turned by the small rest."""
    scaled = (cycles - np.floor(cycles)) * _TURNS
    nearest = int(scaled + 0.5)
    rest = np.float32((scaled - nearest) * (_TWO_PI / _TURNS))
    return _PHASORS[nearest & (_TURNS - 1)] * np.complex64(complex(1.0, -rest))


@njit(cache=True, parallel=True, fastmath=True)
def scatter_echoes(
    scatterers: CellOrder,
    vectors: Vectors,
    table: FieldTable,
    first_depth_mm: float,
    sample_mm: float,
    cycles_per_mm: float,
    out: Complex64Array,
) -> None:
    """Add each scatterer's echo to ``out[vector, sample, node]`` of every vector that it lies near.

    Parameters
    ----------
    first_depth_mm, sample_mm, cycles_per_mm : float
        Depth of the first sample of `out`, depth per sample, and carrier cycles per mm of depth.
    """
    position_mm, amplitude, cell_start = scatterers
    field, reach, curvature_per_mm, grid = table
    ny, nx, _, nodes = field.shape
    samples = out.shape[1]
    for v in prange(vectors.lateral_mm.shape[0]):
        value = np.empty(nodes, dtype=np.complex64)
        for j in range(cell_start[vectors.first[v]], cell_start[vectors.last[v]]):
            fx = abs(position_mm[j, 0] - vectors.lateral_mm[v]) / grid[2]
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
    scatterers: tuple[FloatArray, Float32Array],
    image_from_medium: FloatArray,
    limits: BeamLimits,
    out: tuple[FloatArray, Float32Array],
    filled: int,
) -> int:
    """Append the scatterers within the beam's reach, moved into the image frame; return how many there are.

    Scatterers, and `out`, are positions, shape (n, 3), and strengths, shape (n,).
    """
    position_mm, strength = scatterers
    out_position_mm, out_strength = out
    lateral_mm, depth_mm, thickness_mm = limits
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
    out: CellOrder,
) -> None:
    """Sort by lateral cell and, within it, by depth bin, so that table and vector stay in cache.

    All scatterers must lie inside the cells and between zero and ``deep_mm``. Fills `out`.
    """
    bins = int(deep_mm * _BINS_PER_MM) + 1
    cells = out.start.shape[0] - 1
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
        out.start[i] = count[i * bins]
    for j in range(n):
        at = count[cell[j]]
        count[cell[j]] += 1
        out.position_mm[at] = position_mm[j]
        out.strength[at] = strength[j]
