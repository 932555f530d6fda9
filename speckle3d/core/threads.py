"""Work shared out to the cores of this machine: kernels that release the interpreter, on one pool of threads.

Results do not depend on how many threads there are: each item is worked on alone, and fills its own place.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar, copy_context

_SLICES_PER_CORE = 4
"""So that a core that has done its own share takes from another's."""
_LIMITS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")
_ALONE: ContextVar[bool] = ContextVar("alone", default=False)
_pool: ThreadPoolExecutor | None = None


@contextmanager
def on_one_thread() -> Iterator[None]:
    """Do all work inside on the calling thread: for a cluster's workers, who are given a core each."""
    token = _ALONE.set(True)
    try:
        yield
    finally:
        _ALONE.reset(token)


def cores() -> int:
    """Threads to work on at once: the processors this process may use, or fewer if the environment says so.

    One inside `on_one_thread`. ``NUMBA_NUM_THREADS`` and ``OMP_NUM_THREADS``, with which clusters limit
    their jobs, are obeyed.
    """
    if _ALONE.get():
        return 1
    affinity = getattr(os, "sched_getaffinity", None)
    allowed = len(affinity(0)) if affinity else os.cpu_count() or 1
    limits = (int(value) for name in _LIMITS if (value := os.environ.get(name, "")).isdigit())
    return max(1, min([allowed, *limits]))


def pool() -> ThreadPoolExecutor:
    """Return the threads that all of the process shares, one for each processor."""
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(max(2, os.cpu_count() or 1), "speckle3d")
    return _pool


def in_parallel(function: Callable[[int, int], None], count: int, grain: int = 1) -> None:
    """Call a function with the first and the end of slices of ``range(count)``, until all are done.

    The calling thread works, too, and does what no other thread has begun, so that calls may be nested.

    Parameters
    ----------
    function : callable
        Of a first and an end. Should release the interpreter for most of its time.
    count : int
        Of the items, independent of each other.
    grain : int
        Items below which a slice is not worth another thread's while.
    """
    threads = min(cores(), -(-count // grain))
    if threads <= 1:
        if count:
            function(0, count)
        return
    size = max(grain, -(-count // (_SLICES_PER_CORE * threads)))
    starts = itertools.count(0, size)

    def work() -> None:
        # The counter gives each start once, whichever thread asks.
        for first in iter(starts.__next__, None):
            if first >= count:
                return
            function(first, min(first + size, count))

    others = [pool().submit(copy_context().run, work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        begun = [other for other in others if not other.cancel()]
        wait(begun)
    for other in begun:
        other.result()


def _forget() -> None:
    """Threads do not live on in a forked process."""
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
