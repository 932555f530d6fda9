"""The scatterer kernels against their NumPy twins."""

import numpy as np
import oracles
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.kernels.scatter import (
    BeamLimits,
    CellOrder,
    FieldTable,
    Vectors,
    gather_near,
    scatter_echoes,
    sort_into_cells,
)


def random_beam(rng):
    field = (rng.standard_normal((6, 5, 8, 3)) + 1j * rng.standard_normal((6, 5, 8, 3))).astype(np.complex64)
    reach = rng.integers(0, 8, (6, 5))
    curvature = rng.uniform(-0.05, 0.05, (6, 2))
    return FieldTable(field, reach, curvature, np.array([1.0, 0.5, 0.2, 0.1]))


def in_cells(position, strength, left_mm, deep_mm, cells):
    ordered = CellOrder(np.empty_like(position), np.empty_like(strength), np.zeros(cells + 1, np.int64))
    sort_into_cells(position, strength, left_mm, 0.3, deep_mm, ordered)
    return ordered


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_echoes_match_every_scatterer_for_every_vector(seed):
    rng = np.random.default_rng(seed)
    table, vector_mm = random_beam(rng), np.array([0.0, 0.3, 0.6])
    position = rng.uniform([-1.0, 0.5, -1.0], [1.6, 4.0, 1.0], (60, 3))
    strength = rng.standard_normal(60).astype(np.float32)
    out = np.zeros((3, 400, 3), np.complex64)
    vectors = Vectors(vector_mm, np.zeros(3, np.int64), np.full(3, 9))
    scatter_echoes(in_cells(position, strength, -1.0, 5.0, 9), vectors, table, 0.0, 0.0115, 9.7, out)
    twin = oracles.scatter_echoes(position, strength, vector_mm, *table, 0.0115, 9.7, out.shape)
    np.testing.assert_allclose(out, twin, atol=2e-5)  # single precision of values of order one


def test_sorting_keeps_every_scatterer_and_finds_it_in_its_cell():
    rng = np.random.default_rng(1)
    position, strength = rng.random((500, 3)) * [3.0, 9.0, 1.0], rng.random(500).astype(np.float32)
    ordered = in_cells(position, strength, 0.0, 9.0, 10)
    assert ordered.start[0] == 0
    assert ordered.start[-1] == 500
    np.testing.assert_array_equal(np.sort(ordered.strength), np.sort(strength))
    for c in range(10):
        inside = ordered.position_mm[ordered.start[c] : ordered.start[c + 1], 0]
        assert ((inside >= 0.3 * c - 1e-12) & (inside < 0.3 * (c + 1) + 1e-12)).all()


def test_gathering_moves_and_keeps_what_the_beam_reaches():
    rng = np.random.default_rng(2)
    position, strength = rng.uniform(-5, 5, (400, 3)), rng.random(400).astype(np.float32)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    matrix = np.block([[turn, rng.standard_normal((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])
    thickness = np.array([1.0, 2.0, 3.0, 2.0, 1.0])
    out, out_strength = np.empty((400, 3)), np.empty(400, np.float32)
    limits = BeamLimits(np.array([-2.0, 3.0]), np.array([0.5, 1.0]), thickness)
    n = gather_near((position, strength), matrix, limits, (out, out_strength), 0)
    moved = position @ matrix[:3, :3].T + matrix[:3, 3]
    row = np.floor((moved[:, 1] - 0.5) / 1.0).astype(int)
    kept = (row >= 0) & (row < 4) & (moved[:, 0] > -2.0) & (moved[:, 0] < 3.0)
    kept &= np.abs(moved[:, 2]) < thickness[np.clip(row, 0, 4)]
    assert 0 < n < 400
    np.testing.assert_allclose(out[:n], moved[kept], atol=1e-12)
    np.testing.assert_array_equal(out_strength[:n], strength[kept])
