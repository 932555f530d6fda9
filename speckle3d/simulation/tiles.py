"""What is made tile by tile, each from its own seed, and kept while neighbouring frames need it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable
from functools import partial
from threading import Lock
from typing import Generic, TypeVar

Made = TypeVar("Made")


def tile_seed(i: int, j: int) -> tuple[int, int]:
    """Tile indices as non-negative numbers, which seeds require, distinct on either side of the origin."""
    return i % 2**32, j % 2**32


class _Tile(Generic[Made]):
    def __init__(self, make: Callable[[], Made]) -> None:
        self._make, self._made = make, list[Made]()
        self._lock = Lock()

    def begin(self) -> None:
        """Make it, unless it is made or being made."""
        if not self._made and self._lock.acquire(blocking=False):
            try:
                self._fill()
            finally:
                self._lock.release()

    def get(self) -> Made:
        with self._lock:
            self._fill()
        return self._made[0]

    def _fill(self) -> None:
        if not self._made:
            self._made.append(self._make())


class Tiles(Generic[Made]):
    """The last `most` tiles that were asked for, each made once, whichever threads ask.

    Parameters
    ----------
    make : callable
        Of a tile's two indices; makes the same whenever it is called.
    """

    def __init__(self, make: Callable[[int, int], Made], most: int) -> None:
        self._make, self._most = make, most
        self._kept: OrderedDict[tuple[int, int], _Tile[Made]] = OrderedDict()
        self._lock = Lock()

    def __len__(self) -> int:
        return len(self._kept)

    def __reduce__(self) -> tuple[type[Tiles[Made]], tuple[Callable[[int, int], Made], int]]:
        """Copies make their own tiles."""
        return type(self), (self._make, self._most)

    def __call__(self, indices: Iterable[tuple[int, int]]) -> list[Made]:
        """Return tiles; threads that need the same ones share the work of making them."""
        tiles = [self._tile(int(i), int(j)) for i, j in indices]
        for tile in tiles:
            tile.begin()
        return [tile.get() for tile in tiles]

    def _tile(self, i: int, j: int) -> _Tile[Made]:
        with self._lock:
            tile = self._kept.pop((i, j), None) or _Tile(partial(self._make, i, j))
            self._kept[i, j] = tile
            if len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return tile
