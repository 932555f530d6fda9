"""Schedulers of a study's jobs: this process, local processes, or a Dask cluster.

A job is a function of one argument that returns a result; all ways call the same function with the same
argument, so the results are the same.
"""

from __future__ import annotations

import importlib
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.threads import on_one_thread
from speckle3d.io.hdf5 import one_line

Job = TypeVar("Job")
Result = TypeVar("Result")

CONNECT_S = 20
"""How long a cluster may take to answer; one on the same network takes far below a second."""


@dataclass(frozen=True)
class Scheduler:
    """Runs jobs, each on one thread of a process.

    Attributes
    ----------
    workers : int
        Processes of this machine; with 1, jobs run in this process, one after another.
    client : distributed.Client, optional
        Of a Dask cluster on which to run instead. It gives the tasks of a worker that dies to others.
    """

    workers: int = 1
    client: Any = None

    def run(
        self, function: Callable[[Job], Result], jobs: Sequence[Job], failure: Callable[[Job, str], Result]
    ) -> Iterator[Result]:
        """Yield the result of each job as it completes, or `failure` of one whose worker died."""
        if self.client is None and self.workers == 1:
            yield from map(function, jobs)
            return
        # Not pure: a job's key must not be taken for that of an earlier study that is still held.
        threads = self.client is None and ThreadPoolExecutor(self.workers)
        call = _in_process if threads else _alone
        with threads or self.client.get_executor(pure=False) as executor:
            futures = {executor.submit(call, function, job): job for job in jobs}
            try:
                for future in as_completed(futures):
                    error = future.exception()
                    reason = error and f"its worker died or failed: {one_line(error)}"
                    yield failure(futures[future], reason) if reason else future.result()
            finally:
                for future in futures:
                    future.cancel()


@contextmanager
def scheduler_for(address: str | None, workers: int | None) -> Iterator[Scheduler]:
    """Open a scheduler: the cluster at `address`, local processes, or this process.

    A cluster's security is its own: what Dask's configuration says of certificates is used.

    Raises
    ------
    InvalidInputError
        If Dask is not installed.
    FileError
        If no cluster answers at the address.
    """
    if address is None:
        yield Scheduler(workers or 1)
        return
    try:
        client = importlib.import_module("distributed").Client(address, timeout=CONNECT_S)
    except ImportError as error:
        advice = "a cluster needs dask[distributed]: pip install 'speckle3d[cluster]', got none installed"
        raise InvalidInputError(advice) from error
    except (OSError, ValueError) as error:
        raise FileError(f"{address}: expected a Dask scheduler, got none: {one_line(error)}") from error
    with client:
        if not client.nthreads():
            raise FileError(f"{address}: expected workers on the cluster, got none")
        yield Scheduler(client=client)


def _in_process(function: Callable[[Job], Result], job: Job) -> Result:
    """Run a job in a process of its own, which takes no other with it if it dies."""
    # Spawned: threads of this process, which a fork would not take along, may hold locks. Ctrl-C, which a
    # terminal sends to every process, ends it without a traceback.
    context, quiet = multiprocessing.get_context("spawn"), (signal.SIGINT, signal.SIG_DFL)
    with ProcessPoolExecutor(1, context, signal.signal, quiet) as process:
        return process.submit(_alone, function, job).result()


def _alone(function: Callable[[Job], Result], job: Job) -> Result:
    """Run a job on a worker, without a second thread."""
    with on_one_thread():
        return function(job)
