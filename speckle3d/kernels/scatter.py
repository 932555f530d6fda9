"""Summing the echoes of point scatterers into the baseband of each vector."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable

from speckle3d.core.arrays import Complex64Array, Float32Array, FloatArray, IntArray
from speckle3d.kernels.slicing import coordinates

_SUMS = {"reassoc", "contract", "arcp"}
_TURNS = 8192
_TWO_PI = 2.0 * np.pi
_PHASORS = np.exp(-1j * _TWO_PI * np.arange(_TURNS) / _TURNS).astype(np.complex64)


class FieldTable(NamedTuple):
    """The two-way beam, laid out so that one loop serves all vectors on one side of a scatterer.

    The lateral steps divide the vectors' pitch: a scatterer that lies `r` steps and a fraction from the
    nearest vector on one side lies ``r + m * steps per pitch`` steps and the same fraction from the m-th.

    Attributes
    ----------
    rows : float32, shape (y, z, steps per pitch + 1, m * nodes * 2)
        Two-way residual amplitude, real and imaginary parts in turn.
    reach : int64, shape (y, steps per pitch, m)
        How many elevational steps the beam reaches; beyond that the field is left out.
    vectors : int64, shape (y, z, steps per pitch)
        How many vectors on one side may be in reach.
    curvature_per_mm : float64, shape (y, 2)
        Path curvature, lateral and elevational: the echo comes from depth ``y + kx x^2 + kz z^2``.
    grid : float64, shape (4,)
        First depth, depth step, lateral step, elevational step, mm.
    """

    rows: Float32Array
    reach: IntArray
    vectors: IntArray
    curvature_per_mm: FloatArray
    grid: FloatArray


class EchoGrid(NamedTuple):
    """Sampling of echoes: depths and the carrier's cycles per mm."""

    first_depth_mm: float
    sample_mm: float
    cycles_per_mm: float


def field_table(
    field: Complex64Array, reach: IntArray, curvature_per_mm: FloatArray, grid: FloatArray, per_pitch: int
) -> FieldTable:
    """Lay out a beam, shape (y, x, z, nodes), with its reach, shape (y, x), as `FieldTable` says."""
    ny, nx, nz, nodes = field.shape
    most = -(-nx // per_pitch)
    steps = np.zeros((ny, most * per_pitch + per_pitch, nz, nodes), np.complex64)
    steps[:, :nx] = field
    rows = np.stack([steps[:, r : r + most * per_pitch : per_pitch] for r in range(per_pitch + 1)], axis=2)
    rows = np.ascontiguousarray(rows.transpose(0, 3, 2, 1, 4)).view(np.float32)
    # Between the last lateral step and the one after it, there is nothing to interpolate.
    steps_z = np.zeros((ny, most * per_pitch), np.int64)
    steps_z[:, : nx - 1] = reach[:, : nx - 1]
    steps_z = np.ascontiguousarray(steps_z.reshape(ny, most, per_pitch).transpose(0, 2, 1))
    inside = np.arange(nz)[:, None, None] < steps_z[:, None]
    vectors = np.where(inside.any(axis=-1), most - np.argmax(inside[..., ::-1], axis=-1), 0)
    return FieldTable(rows.reshape(ny, nz, per_pitch + 1, -1), steps_z, vectors, curvature_per_mm, grid)


@njit(cache=True, inline="always", fastmath=_SUMS)
def _unit_phasor(cycles: float) -> Any:
    """``exp(-2 pi i cycles)`` to 1e-7: the nearest tabulated phasor, turned by the small angle to it."""
    place = (cycles - np.floor(cycles)) * _TURNS
    nearest = int(place + 0.5)
    angle = np.float32((place - nearest) * (_TWO_PI / _TURNS))
    return _PHASORS[nearest & (_TURNS - 1)] * np.complex64(complex(1.0, -angle))


@njit(cache=True, inline="always", fastmath=_SUMS)
def _first_array(array_from_face: FloatArray, x: float, y: float, right_mm: float) -> int:
    """First array of a fan in which a place lies left of `right_mm`; in the next ones it is farther left."""
    low, high = 0, array_from_face.shape[0]
    while low < high:
        middle = (low + high) // 2
        t = array_from_face[middle, 0]
        if t[0] * x + t[1] * y + t[2] < right_mm:
            high = middle
        else:
            low = middle + 1
    return low


@register_jitable(fastmath=_SUMS, error_model="numpy")
def _interpolate(table: Float32Array, row: int, corners: Any, weights: Any, out: Float32Array) -> None:
    """Fill `out` with a weighted sum of eight pieces of a table.

    Two lie a `row` apart from each of the corners, of two depths and two elevations: two lateral steps.
    """
    w0, w1, w2, w3, w4, w5, w6, w7 = weights
    c0, c1, c2, c3 = corners
    n = out.shape[0]
    # Slices, not offsets: an index that may be negative keeps the compiler from using vector instructions.
    a0, a1, a2, a3 = table[c0:][:n], table[c0 + row :][:n], table[c1:][:n], table[c1 + row :][:n]
    a4, a5, a6, a7 = table[c2:][:n], table[c2 + row :][:n], table[c3:][:n], table[c3 + row :][:n]
    for q in range(n):
        near = w0 * a0[q] + w1 * a1[q] + w2 * a2[q] + w3 * a3[q]
        out[q] = near + (w4 * a4[q] + w5 * a5[q] + w6 * a6[q] + w7 * a7[q])


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS)
def scatter_echoes(
    position_mm: FloatArray,
    strength: Float32Array,
    pitch_mm: float,
    face_from_medium: FloatArray,
    array_from_face: FloatArray,
    table: FieldTable,
    echoes: EchoGrid,
    out: Float32Array,
) -> None:
    """Add each scatterer's echo to ``out[vector, sample]`` of every vector that it lies near.

    Vectors lie in arrays of equally many that are parallel: all in one, or each of a fan's in one of its own.

    Fastest if neighbours in the list are of similar depth: the beam's table is long.

    Parameters
    ----------
    position_mm, strength : ndarray, shape (n, 3) and (n,)
        Scatterers in the medium.
    pitch_mm : float
        Of an array's vectors, of which the first is at zero.
    face_from_medium : float64, shape (4, 4)
        Along the image's axes.
    array_from_face : float64, shape (arrays, 2, 3)
        Affine map from (x, y, 1) in the image plane to x and y in each array.
    out : float32, shape (vector, sample, nodes * 2)
        Real and imaginary parts in turn.
    """
    rows, reach, reached_vectors, curvature_per_mm, grid = table
    first_depth_mm, sample_mm, cycles_per_mm = echoes
    ny, nz = reached_vectors.shape[0], reached_vectors.shape[1]
    per_pitch = reach.shape[1]
    samples, width = out.shape[1:]
    vectors = out.shape[0] // array_from_face.shape[0]
    far_mm = reach.shape[2] * pitch_mm
    right_mm = vectors * pitch_mm + far_mm
    row = rows.shape[3]
    cell = (per_pitch + 1) * row
    plane = nz * cell
    flat = rows.reshape(rows.size)
    one = np.float32(1.0)
    value = np.empty(rows.shape[3], dtype=np.float32)
    for j in range(position_mm.shape[0]):
        a, b, c = position_mm[j]
        face_x, face_y, z = coordinates(face_from_medium, a, b, c)
        fz = abs(z) / grid[3]
        iz = int(fz)
        if iz >= nz - 1:
            continue
        wz = np.float32(fz - iz)
        for array in range(_first_array(array_from_face, face_x, face_y, right_mm), array_from_face.shape[0]):
            t = array_from_face[array]
            x = t[0, 0] * face_x + t[0, 1] * face_y + t[0, 2]
            if x <= -far_mm:
                break
            y = t[1, 0] * face_x + t[1, 1] * face_y + t[1, 2]
            fy = (y - grid[0]) / grid[1]
            iy = int(np.floor(fy))
            if iy < 0 or iy >= ny - 1:
                continue
            part = fy - iy
            wy = np.float32(part)
            kx = (1.0 - part) * curvature_per_mm[iy, 0] + part * curvature_per_mm[iy + 1, 0]
            kz = (1.0 - part) * curvature_per_mm[iy, 1] + part * curvature_per_mm[iy + 1, 1]
            axis_mm = y + kz * z * z
            w00 = strength[j] * (one - wy) * (one - wz)
            w01 = strength[j] * (one - wy) * wz
            w10 = strength[j] * wy * (one - wz)
            w11 = strength[j] * wy * wz
            right = int(np.ceil(x / pitch_mm))
            for side in range(2):
                # From the scatterer to the right, its nearest vector included, then to the left.
                nearest = right - side
                turn = 1 - 2 * side
                steps = turn * (nearest * pitch_mm - x) / grid[2]
                r = min(int(steps), per_pitch - 1)
                if side == 0:
                    first, last = max(0, -nearest), vectors - nearest
                else:
                    first, last = max(0, nearest - vectors + 1), nearest + 1
                last = min(last, reached_vectors[iy, iz, r])
                if first >= last:
                    continue
                wx = np.float32(steps - r)
                wl = one - wx
                weights = (w00 * wl, w00 * wx, w01 * wl, w01 * wx, w10 * wl, w10 * wx, w11 * wl, w11 * wx)
                b = ((iy * nz + iz) * (per_pitch + 1) + r) * row + first * width
                corners = (b, b + cell, b + plane, b + plane + cell)
                _interpolate(flat, row, corners, weights, value[first * width : last * width])
                for n in range(first, last):
                    if iz >= reach[iy, r, n]:
                        continue
                    across_mm = (steps + n * per_pitch) * grid[2]
                    echo_mm = axis_mm + kx * across_mm * across_mm
                    at = (echo_mm - first_depth_mm) / sample_mm
                    sample = int(np.floor(at))
                    if sample < 0 or sample >= samples - 1:
                        continue
                    # The carrier's phase is exact; only the slow baseband is split between two samples.
                    late = np.float32(at - sample)
                    early = one - late
                    carrier = _unit_phasor(cycles_per_mm * echo_mm)
                    line = out[array * vectors + nearest + turn * n]
                    for k in range(width // 2):
                        q = n * width + 2 * k
                        re = carrier.real * value[q] - carrier.imag * value[q + 1]
                        im = carrier.real * value[q + 1] + carrier.imag * value[q]
                        line[sample, 2 * k] += early * re
                        line[sample, 2 * k + 1] += early * im
                        line[sample + 1, 2 * k] += late * re
                        line[sample + 1, 2 * k + 1] += late * im
