"""Tiles that are made once, whichever threads ask, and forgotten in the order they were asked for."""

import copy
import pickle
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from speckle3d.simulation.tiles import Tiles, tile_seed


def test_threads_that_need_the_same_tiles_share_the_work():
    made, both = [], threading.Barrier(2, timeout=20)

    def make(i, j):
        made.append((i, j))
        both.wait()  # passed only if two threads make a tile each at the same time
        return i + j

    tiles = Tiles(make, 8)
    wanted = [(0, 1), (2, 3)]
    with ThreadPoolExecutor(2) as pool:
        assert [each.result() for each in [pool.submit(tiles, wanted) for _ in range(2)]] == [[1, 5]] * 2
    assert sorted(made) == wanted


def test_the_last_tiles_are_kept():
    made = []
    tiles = Tiles(lambda i, j: made.append((i, j)), 2)
    tiles([(0, 0), (1, 0)])
    tiles([(0, 0), (2, 0)])
    tiles([(0, 0), (2, 0), (1, 0)])
    assert made == [(0, 0), (1, 0), (2, 0), (1, 0)]
    assert len(tiles) == 2


def test_a_tile_that_could_not_be_made_is_tried_again():
    def make(i, j):
        attempts.append(i)
        if len(attempts) == 1:
            raise MemoryError
        return i

    attempts, tiles = [], Tiles(make, 2)
    with pytest.raises(MemoryError):
        tiles([(7, 0)])
    assert tiles([(7, 0)]) == [7]


def test_seeds_differ_on_either_side_of_the_origin():
    assert len({tile_seed(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)}) == 9
    assert min(min(tile_seed(i, j)) for i in (-1, 1) for j in (-1, 1)) >= 0


def test_a_copy_makes_its_own_tiles():
    tiles = Tiles(divmod, 3)
    assert tiles([(7, 2), (9, 4)]) == [(3, 1), (2, 1)]
    for other in (copy.deepcopy(tiles), pickle.loads(pickle.dumps(tiles))):
        assert len(other) == 0
        assert other([(7, 2)]) == [(3, 1)]
