"""Work shared out to the cores of this machine: kernels that release the interpreter, on one pool of threads.

Results do not depend on how many threads there are: each item is worked on alone, and fills its own place.
"""

from __future__ import annotations

import itertools
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from functools import partial
from typing import Generic, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

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
    # OpenMP's may be a list, by depth of nesting.
    told = (os.environ.get(name, "").partition(",")[0].strip() for name in _LIMITS)
    return max(1, min([allowed, *(int(value) for value in told if value.isascii() and value.isdecimal())]))


def _others() -> ThreadPoolExecutor:
    """Return the threads that all of the process shares: fewer by one than cores: callers work, too."""
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(max(1, cores() - 1), "speckle3d")
    return _pool


def end_threads() -> None:
    """Let the shared threads end when they are done.

    One whose start was interrupted is not known to the interpreter, whose end would wait for it for good.
    """
    if _pool is not None:
        _pool.shutdown(wait=False, cancel_futures=True)
        _forget()


def _submitted(work: Callable[[], Result]) -> Future[Result] | None:
    """Give work to another thread; None while the interpreter ends, when there are none."""
    try:
        return _others().submit(work)
    except RuntimeError:
        return None


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

    failed: list[bool] = []

    def work() -> None:
        # The counter gives each start once, whichever thread asks.
        for first in iter(starts.__next__, None):
            if first >= count or failed:
                return
            function(first, min(first + size, count))

    others = [other for _ in range(threads - 1) if (other := _submitted(partial(copy_context().run, work)))]
    try:
        work()
    except BaseException:
        failed.append(True)
        raise
    finally:
        begun = [other for other in others if not other.cancel()]
        wait(begun)
    for other in begun:
        other.result()


def ahead(function: Callable[[Item], Result], items: Iterable[Item], most: int = 3) -> Generator[Result]:
    """Yield what a function makes of items, in order, `most` of them worked out before they are asked for.

    Other threads work ahead; this one helps while it would have to wait. On one core nothing is done ahead.
    """
    if cores() == 1:
        yield from map(function, items)
        return
    waiting: deque[_Ahead[Item, Result]] = deque()
    try:
        for item in items:
            waiting.append(_Ahead(function, item))
            if len(waiting) > most:
                yield _first_of(waiting)
        while waiting:
            yield _first_of(waiting)
    finally:
        wait([each.future for each in waiting if not each.future.cancel()])


class _Ahead(Generic[Item, Result]):
    """The result for one item, which whoever comes first makes."""

    def __init__(self, function: Callable[[Item], Result], item: Item) -> None:
        self._function, self._item = function, item
        work = partial(copy_context().run, function, item)
        self.future: Future[Result] = _submitted(work) or Future()

    def begin_here(self) -> bool:
        """Make the result on this thread, unless it is made or being made."""
        if not self.future.cancel():
            return False
        self.future = Future()
        try:
            self.future.set_result(self._function(self._item))
        except Exception as error:  # noqa: BLE001 (raised when its turn comes; Ctrl-C at once)
            self.future.set_exception(error)
        return True


def _first_of(waiting: deque[_Ahead[Item, Result]]) -> Result:
    first = waiting.popleft()
    first.begin_here()
    while not first.future.done() and any(each.begin_here() for each in waiting):
        pass
    return first.future.result()


def _forget() -> None:
    """Threads do not live on in a forked process."""
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
