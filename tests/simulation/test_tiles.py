"""Tiles that are made once, whichever threads ask, and forgotten in the order they were asked for."""

import threading
from concurrent.futures import ThreadPoolExecutor

from speckle3d.simulation.tiles import Tiles


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
