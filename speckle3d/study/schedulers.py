"""Where a study's jobs run: in this process, in processes of this machine, or on a Dask cluster.

A job is a function of one argument that returns a result and does not raise; all ways call the same function
with the same argument, so the results are the same. Only a worker that dies makes a job fail.
"""

from __future__ import annotations

import importlib
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.threads import on_one_thread
from speckle3d.io.hdf5 import one_line

Job = TypeVar("Job")
Result = TypeVar("Result")

CONNECT_S = 20
"""How long a cluster may take to answer; one on the same network takes far below a second."""

_DIED = "its worker died: killed, crashed or out of memory"


class Scheduler(Protocol):
    """Runs jobs."""

    @property
    def workers(self) -> int:
        """How many jobs run at a time."""

    def run(
        self, function: Callable[[Job], Result], jobs: Sequence[Job], lost: Callable[[Job, str], Result]
    ) -> Iterator[Result]:
        """Yield the result of each job as it comes; of a job whose worker died what `lost` makes of it."""


@dataclass(frozen=True)
class InProcess:
    """Runs one job after another in this process."""

    workers: int = 1

    def run(
        self, function: Callable[[Job], Result], jobs: Sequence[Job], lost: Callable[[Job, str], Result]
    ) -> Iterator[Result]:
        """Yield the result of each job, in order."""
        yield from map(function, jobs)


@dataclass(frozen=True)
class InProcesses:
    """Runs jobs in processes of this machine, each on one thread."""

    workers: int

    def run(
        self, function: Callable[[Job], Result], jobs: Sequence[Job], lost: Callable[[Job, str], Result]
    ) -> Iterator[Result]:
        """Yield the result of each job as it comes.

        A process that dies takes the whole pool with it: its jobs are tried again, each in a process of its
        own, which shows the one that was the cause.
        """
        suspects = []
        for job, future in self._ended(function, jobs, self.workers):
            if isinstance(future.exception(), BrokenProcessPool):
                suspects.append(job)
            else:
                yield future.result()
        for suspect in suspects:
            ((job, future),) = self._ended(function, [suspect], 1)
            died = isinstance(future.exception(), BrokenProcessPool)
            yield lost(job, _DIED) if died else future.result()

    def _ended(
        self, function: Callable[[Job], Result], jobs: Sequence[Job], workers: int
    ) -> Iterator[tuple[Job, Future[Result]]]:
        # Spawned: threads of this process, which a fork would not take along, may hold locks.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, context, _die_of_interrupts) as pool:
            futures = {pool.submit(_alone, function, job): job for job in jobs}
            try:
                for future in as_completed(futures):
                    yield futures[future], future
            finally:
                pool.shutdown(cancel_futures=True)


@dataclass(frozen=True)
class OnCluster:
    """Runs jobs on the workers of a Dask client, which gives the tasks of a worker that dies to others."""

    client: Any

    @property
    def workers(self) -> int:
        """Threads of all workers, as they are now."""
        return max(1, int(sum(self.client.nthreads().values())))

    def run(
        self, function: Callable[[Job], Result], jobs: Sequence[Job], lost: Callable[[Job, str], Result]
    ) -> Iterator[Result]:
        """Yield the result of each job as it comes."""
        # Not pure: a job's key must not be taken for that of an earlier study that is still held.
        futures = {self.client.submit(_alone, function, job, pure=False): job for job in jobs}
        try:
            for future in _distributed().as_completed(list(futures)):
                finished = future.status == "finished"
                yield future.result() if finished else lost(futures[future], one_line(future.exception()))
        finally:
            self.client.cancel(list(futures))


@contextmanager
def scheduler_for(address: str | None, workers: int | None) -> Iterator[Scheduler]:
    """Open where to run: the cluster at `address`, that many processes here, or this process.

    A cluster's security is its own: what Dask's configuration says of certificates is used.

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
    if address is None:
        yield InProcess() if workers in (None, 1) else InProcesses(workers or 1)
        return
    try:
        client = _distributed().Client(address, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise FileError(f"{address}: expected a Dask scheduler, got none: {one_line(error)}") from error
    with client:
        if not client.nthreads():
            raise FileError(f"{address}: expected workers on the cluster, got none")
        yield OnCluster(client)


def _alone(function: Callable[[Job], Result], job: Job) -> Result:
    """Run a job on a worker, without a second thread."""
    with on_one_thread():
        return function(job)


def _die_of_interrupts() -> None:
    """Let Ctrl-C, which a terminal sends to every process, end a worker without a traceback."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _distributed() -> Any:
    """Import Dask's distributed part, which is an extra."""
    try:
        return importlib.import_module("distributed")
    except ImportError as error:
        raise InvalidInputError(
            "a cluster needs dask[distributed]: pip install 'speckle3d[cluster]', got none installed"
        ) from error
