"""Work shared out to threads: every item once, in order, nesting without a deadlock."""

import subprocess
import sys
import threading

import numpy as np
import pytest

from speckle3d.core import threads
from speckle3d.core.threads import ahead, cores, in_parallel, on_one_thread


@pytest.fixture(autouse=True)
def four_cores(monkeypatch):
    monkeypatch.setattr(threads, "processors", lambda: 4)


@pytest.mark.parametrize("count", [0, 7, 100])
def test_does_every_item_once(count):
    visits = np.zeros(count, dtype=int)

    def visit(first, stop):
        visits[first:stop] += 1

    in_parallel(visit, count)
    assert (visits == 1).all()


def test_calls_may_be_nested_deeper_than_there_are_threads():
    leaves = []

    def recurse(first, stop, depth=4):
        if depth:
            in_parallel(lambda f, s: recurse(f, s, depth - 1), 8)
        else:
            leaves.append(1)

    in_parallel(recurse, 8)
    assert len(leaves) >= 8


def test_workers_of_a_cluster_and_the_environment_limit_the_threads(monkeypatch):
    monkeypatch.undo()
    monkeypatch.setenv("OMP_NUM_THREADS", "1,4")
    assert cores() == 1
    monkeypatch.delenv("OMP_NUM_THREADS")
    with on_one_thread():
        assert cores() == 1


def test_results_made_ahead_come_in_order_and_not_too_many_of_them():
    starts = []

    def slowest_first(item):
        starts.append(item)
        threading.Event().wait(0.002 * (8 - item))
        return 10 * item

    results = ahead(slowest_first, range(8), most=3)
    assert next(results) == 0
    assert max(starts) <= 4
    assert list(results) == [10 * item for item in range(1, 8)]


INTERRUPTED = """
import threading
from speckle3d.core import threads

start = threading.Thread.start

def interrupt(thread):
    start(thread)
    raise KeyboardInterrupt

threading.Thread.start = interrupt
threads.processors = lambda: 2
try:
    threads.in_parallel(lambda first, end: None, 100)
except KeyboardInterrupt:
    threads.end_threads()
"""


def test_a_process_ends_whose_thread_was_interrupted_as_it_began():
    assert subprocess.run([sys.executable, "-c", INTERRUPTED], timeout=60).returncode == 0
