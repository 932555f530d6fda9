from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from speckle3d.core import memory
from speckle3d.core.memory import borrowed


def place(array):
    return array.__array_interface__["data"][0]


@pytest.mark.parametrize(("shape", "dtype"), [((3, 70), np.complex64), ((1,), np.uint8)])
def test_an_array_as_asked_for_on_a_cache_line(shape, dtype):
    array = borrowed(shape, dtype)
    array[:] = 7
    assert (array.shape, array.dtype) == (shape, dtype)
    assert array.flags.c_contiguous
    assert array.flags.writeable
    assert place(array) % 64 == 0


def test_memory_is_used_again_once_no_view_of_it_is_left():
    first = borrowed((911, 1013), np.float32)
    at, view = place(first), first[5:, ::2].view(np.int32)
    view[:] = 3
    del first
    second = borrowed((911, 1013), np.float32)
    second[:] = -1
    assert place(second) != at
    assert (view == 3).all()
    del view
    assert place(borrowed((911 * 1013, 4), np.uint8)) == at


def test_threads_share_no_memory_that_is_in_use():
    def fill(value):
        arrays = [borrowed((64, 1021), np.float64) for _ in range(3)]
        for i, array in enumerate(arrays):
            array[:] = 10 * value + i
        return [(array == 10 * value + i).all() for i, array in enumerate(arrays)]

    with ThreadPoolExecutor(4) as threads:
        assert np.all(list(threads.map(fill, range(200))))


def test_no_more_is_kept_than_the_limit(monkeypatch):
    monkeypatch.setattr(memory, "_pieces", defaultdict(list))
    monkeypatch.setattr(memory, "_MOST_BYTES", 2**20)
    held = [borrowed((2**18,), np.uint8) for _ in range(6)]
    for i, array in enumerate(held):
        array[:] = i
    assert [int(array[-1]) for array in held] == list(range(6))
    assert sum(size * len(kept) for size, kept in memory._pieces.items()) == 2**20
    del held, array
    borrowed((2**19,), np.uint8)
    assert sum(size * len(kept) for size, kept in memory._pieces.items()) <= 2**20
