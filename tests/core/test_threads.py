"""Work shared out to threads: every item once, errors told, nesting without a deadlock."""

import threading

import numpy as np
import pytest

from speckle3d.core import threads
from speckle3d.core.threads import cores, in_parallel, on_one_thread


@pytest.fixture(autouse=True)
def four_cores(monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: 4)


@pytest.mark.parametrize("count", [0, 1, 2, 7, 100])
def test_does_every_item_once(count):
    done = np.zeros(count, dtype=int)

    def one(first, stop):
        done[first:stop] += 1

    in_parallel(one, count)
    assert (done == 1).all()


def test_small_work_stays_on_the_calling_thread():
    used = set()
    in_parallel(lambda first, stop: used.add(threading.get_ident()), 10, grain=10)
    assert used == {threading.get_ident()}


def test_an_error_of_any_thread_reaches_the_caller():
    def bad(first, stop):
        if first <= 37 < stop:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        in_parallel(bad, 64)


def test_calls_may_be_nested_deeper_than_there_are_threads():
    done = []

    def nested(first, stop, depth=4):
        if depth:
            in_parallel(lambda f, s: nested(f, s, depth - 1), 8)
        else:
            done.append(1)

    in_parallel(nested, 8)
    assert len(done) >= 8


def test_workers_of_a_cluster_and_the_environment_limit_the_threads(monkeypatch):
    monkeypatch.undo()
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert cores() == 1
    monkeypatch.delenv("OMP_NUM_THREADS")
    with on_one_thread():
        assert cores() == 1
    assert cores() >= 1
