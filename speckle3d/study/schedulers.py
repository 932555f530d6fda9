"""Where a study's jobs run: in this process one after another, or on the workers of a Dask cluster.

A job is a function of one argument that returns a result and does not raise; both ways call the same
function with the same argument, so the results are the same. A job whose worker dies is tried again on
others; one that takes several workers with it becomes a result by `lost` and does not stop the study. A job
may come after others: it starts when they have ended, and is lost if one of them was.
"""

from __future__ import annotations

import importlib
import os
import signal
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.threads import on_one_thread
from speckle3d.io.hdf5 import one_line

Job = TypeVar("Job")
Result = TypeVar("Result")
After = Mapping[int, Collection[int]]
"""Numbers of the jobs that each job comes after, all of them lower than its own."""

CONNECT_S = 20
"""How long a cluster may take to answer; one on the same network takes far below a second."""

DESERTED_S = 60
"""How long a cluster may be without any worker; a killed one is started again within seconds."""

_PROFILE = "distributed.worker.profile.enabled"
"""Whether Dask's workers sample their own stack, a hundred times a second; nothing here reads it."""

_PAGES = (
    "distributed.scheduler.http.routes",
    "distributed.worker.http.routes",
    "distributed.nanny.http.routes",
)
"""Dask's settings of what its processes show on the network."""

_DESERTED = "the cluster has had no worker for a minute"
_KILLED = "every worker that tried it died: killed, crashed or out of memory"


class InProcess:
    """Runs one job after another in this process."""

    workers = 1
    """How many jobs run at a time."""

    def run(
        self,
        function: Callable[[Job], Result],
        jobs: Sequence[Job],
        lost: Callable[[Job, str], Result],
        after: After | None = None,
    ) -> Iterator[tuple[int, Result]]:
        """Yield the number of each job and its result, in order."""
        for number, job in enumerate(jobs):
            yield number, function(job)


@dataclass(frozen=True)
class OnCluster:
    """Runs jobs on the workers of a Dask client.

    Each job is one task, given to a worker when it is free; a job that comes after others depends on their
    tasks. The task of a worker that dies is given to another; a task that has taken several workers with it
    is given up. Jobs that come after others go first, then those that others wait for.
    """

    client: Any

    def run(
        self,
        function: Callable[[Job], Result],
        jobs: Sequence[Job],
        lost: Callable[[Job, str], Result],
        after: After | None = None,
    ) -> Iterator[tuple[int, Result]]:
        """Yield the number of each job and its result as they come."""
        before = {number: (after or {}).get(number, ()) for number in range(len(jobs))}
        suspects = []
        for number, reason, result in self._arriving(function, jobs, before):
            if reason == _KILLED:
                suspects.append(number)
            else:
                yield number, result if reason is None else lost(jobs[number], reason)
        # The cluster blames a death on every task that waited at the worker and on those that depend on them:
        # each shows alone whether it was the cause.
        given_up: dict[int, str] = {}
        for number in sorted(suspects):
            reason = next((given_up[each] for each in before[number] if each in given_up), None)
            result = None
            if reason is None:
                ((_, reason, result),) = self._arriving(function, jobs, {number: ()})
            if reason is not None:
                given_up[number] = reason
            yield number, result if reason is None else lost(jobs[number], reason)

    def _arriving(
        self, function: Callable[[Job], Result], jobs: Sequence[Job], before: After
    ) -> Iterator[tuple[int, str | None, Any]]:
        """Submit jobs; yield the number, why it failed or None, and the result of each as it ends."""
        futures: dict[int, Any] = {}
        needed = {each for others in before.values() for each in others}
        for number, others in before.items():
            # Not pure: a job's key must not be taken for that of an earlier study that is still held.
            futures[number] = self.client.submit(
                _on_one_thread,
                function,
                jobs[number],
                [futures[each] for each in others],
                pure=False,
                priority=2 if others else int(number in needed),
            )
        numbers = {future.key: number for number, future in futures.items()}
        arriving = _dask().as_completed(list(futures.values()))
        try:
            while futures:
                if not self._one_has_ended(arriving):
                    for number in futures:
                        yield number, _DESERTED, None
                    return
                future = next(arriving)
                reason = _failure(future)
                result = future.result() if reason is None else None
                # A result that is still asked for would be made again if its worker died.
                futures.pop(numbers[future.key]).release()
                yield numbers[future.key], reason, result
        finally:
            self.client.cancel(list(futures.values()))

    def _one_has_ended(self, arriving: Any) -> bool:
        """Wait for a job to end; False if there has been no worker for long."""
        looked = deserted_since = time.monotonic()
        while not arriving.has_ready():
            time.sleep(0.01)
            now = time.monotonic()
            if now - looked > 1.0:
                looked = now
                deserted_since = now if self.client.nthreads() else deserted_since
                if now - deserted_since > DESERTED_S:
                    return False
        return True

    @property
    def workers(self) -> int:
        """Threads of all workers, as they are now."""
        return max(1, int(sum(self.client.nthreads().values())))


Scheduler = InProcess | OnCluster


@contextmanager
def scheduler_for(address: str | None, workers: int | None) -> Iterator[Scheduler]:
    """Open where to run: the cluster at `address`, that many processes here, or this process.

    Raises
    ------
    InvalidInputError
        If both are asked for, or Dask is not installed.
    FileError
        If no cluster answers at the address.
    """
    if address is not None and workers is not None:
        raise InvalidInputError("expected --scheduler or --workers, got both")
    if workers is not None and workers < 1:
        raise InvalidInputError(f"--workers: expected at least 1, got {workers}")
    if address is None and workers in (None, 1):
        yield InProcess()
        return
    with local_cluster(workers or 1) if address is None else _connected(address) as client:
        yield OnCluster(client)


@contextmanager
def local_cluster(workers: int) -> Iterator[Any]:
    """Client of a cluster of single-threaded worker processes on this machine; both end with the block.

    Who can talk to a scheduler can run code as its user, and its port is open to every user of the machine.
    So all talk is encrypted, with a key that is made for this cluster, is never on disk, and without which a
    connection is refused; and none of Dask's pages are served.
    """
    # A worker has one thread: more threads in the kernels would only compete with the other workers.
    env = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    security = _fresh_key()
    silent = importlib.import_module("dask").config.set({_PROFILE: False} | {key: [] for key in _PAGES})
    with _without_interrupts(), silent:
        cluster = _dask().LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            protocol="tls://",
            security=security,
            dashboard_address=None,
            # Without a dashboard it still opens its port, the same for every cluster; 0 is a free one.
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
            memory_limit=0,
            silence_logs=50,
            env=env | {"MPLBACKEND": os.environ.get("MPLBACKEND", "agg")},
        )
    with cluster, _dask().Client(cluster) as client:
        yield client


def _fresh_key() -> Any:
    """Key and certificate that only this process and those it starts know."""
    try:
        return _dask().Security.temporary()
    except ImportError as error:
        raise InvalidInputError(
            "--workers needs cryptography, which keeps other users of this machine out: "
            "pip install 'speckle3d[cluster]', got none installed"
        ) from error


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Start processes that ignore Ctrl-C; a Ctrl-C during these seconds is lost.

    A terminal sends it to every process. The study's own process then ends its workers, which need not print
    a traceback each. Signals that a process ignores are ignored by the processes that it starts.
    """
    if threading.current_thread() is not threading.main_thread():  # only the main thread may set handlers
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if before is None else before)


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    dask = _dask()
    try:
        client = dask.Client(address, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise FileError(f"{address}: expected a Dask scheduler, got none: {one_line(error)}") from error
    with client:
        if not client.nthreads():
            raise FileError(f"{address}: expected workers on the cluster, got none")
        yield client


def _on_one_thread(function: Callable[[Job], Result], job: Job, _before: Sequence[object]) -> Result:
    """Run a job on a worker, without a second thread; its arguments include the results it comes after."""
    with on_one_thread():
        return function(job)


def _failure(future: Any) -> str | None:
    """Why a task that has ended has no result; None if it has one."""
    if future.status == "finished":
        return None
    if future.status == "cancelled":
        return "cancelled by the cluster"
    error, kind = future.exception(), type(future.exception()).__name__
    return _KILLED if kind == "KilledWorker" else f"{kind}: {one_line(error)}"


def _dask() -> Any:
    """Import Dask's distributed part, which is an extra."""
    try:
        return importlib.import_module("distributed")
    except ImportError as error:
        raise InvalidInputError(
            "a cluster needs dask[distributed]: pip install 'speckle3d[cluster]', got none installed"
        ) from error
