"""Thread pool for kernels that release the interpreter.

Results do not depend on how many threads there are: each item is worked on alone, and fills its own place.
Work that threads of the pool share out themselves is done on them, so that none waits for another.
"""

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

_SLICES_PER_CORE = 4
"""So that a core that has done its own share takes from another's."""
_ALONE: ContextVar[bool] = ContextVar("alone", default=False)


@contextmanager
def on_one_thread() -> Iterator[None]:
    """Do all work inside on the calling thread: for a cluster's workers, who are given a core each."""
    token = _ALONE.set(True)
    try:
        yield
    finally:
        _ALONE.reset(token)


def cores() -> int:
    """Threads to work on at once: the processors this process may use, one inside `on_one_thread`."""
    return 1 if _ALONE.get() else processors()


def processors() -> int:
    """Count the processors this process may use, or fewer if the environment says so.

    ``NUMBA_NUM_THREADS`` and ``OMP_NUM_THREADS``, with which clusters limit their jobs, are obeyed.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    allowed = len(affinity(0)) if affinity else os.cpu_count() or 1
    # OpenMP's may be a list, by depth of nesting.
    limits = (
        os.environ.get(name, "").partition(",")[0].strip()
        for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")
    )
    return max(1, min([allowed, *(int(value) for value in limits if value.isdecimal())]))


@cache
def _pool() -> ThreadPoolExecutor:
    """Return the threads that all of the process shares, each of which works alone."""
    return ThreadPoolExecutor(processors(), "speckle3d", _ALONE.set, (True,))


def end_threads() -> None:
    """Let the shared threads end when they are done.

    One whose start was interrupted is not known to the interpreter, whose end would wait for it for good.
    """
    _pool().shutdown(wait=False, cancel_futures=True)
    _pool.cache_clear()


if hasattr(os, "register_at_fork"):
    # Threads do not live on in a forked process.
    os.register_at_fork(after_in_child=_pool.cache_clear)


def in_parallel(function: Callable[[int, int], None], count: int, grain: int = 1) -> None:
    """Call a function with the first and the end of slices of ``range(count)``, until all are done.

    Parameters
    ----------
    function : callable
        Of a first and an end. Should release the interpreter for most of its time.
    count : int
        Of the items, independent of each other.
    grain : int
        Items below which a slice is not worth another thread's while.
    """
    size = count if cores() == 1 else max(grain, -(-count // (_SLICES_PER_CORE * cores())))
    starts = range(0, count, max(size, 1))
    deque(ahead(lambda first: function(first, min(first + size, count)), starts, len(starts)), maxlen=0)


def ahead(function: Callable[[Item], Result], items: Iterable[Item], most: int = 3) -> Generator[Result]:
    """Map a function over items in order, computing up to `most` results ahead.

    Other threads work ahead; on one core nothing is done ahead.
    """
    if cores() == 1:
        yield from map(function, items)
        return
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:
            waiting.append(_pool().submit(function, item))
            if len(waiting) > most:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        wait([future for future in waiting if not future.cancel()])
