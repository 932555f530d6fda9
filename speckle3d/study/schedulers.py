"""Where a study's jobs run: in this process, in processes of this machine, or on a Dask cluster.

A job is a function of one argument that returns a result; all ways call the same function with the same
argument, so the results are the same.
"""

from __future__ import annotations

import importlib
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
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
        self, function: Callable[[Job], Result], jobs: Sequence[Job], lost: Callable[[Job, str], Result]
    ) -> Iterator[Result]:
        """Yield the result of each job as it comes; of a job whose worker died what `lost` makes of it.

        A process that dies takes the whole pool with it: its jobs are tried again, each in a process of its
        own, which shows the one that was the cause.
        """
        if self.client is None and self.workers == 1:
            yield from map(function, jobs)
            return
        again = []
        with self._executor() as executor:
            futures = {executor.submit(_alone, function, job): job for job in jobs}
            try:
                for future in as_completed(futures):
                    job, error = futures[future], future.exception()
                    if error is None:
                        yield future.result()
                    elif isinstance(error, BrokenProcessPool) and len(jobs) > 1:
                        again.append(job)
                    else:
                        died = "its worker died: killed, crashed or out of memory"
                        yield lost(job, died if isinstance(error, BrokenProcessPool) else one_line(error))
            finally:
                for future in futures:
                    future.cancel()
        for job in again:
            yield from self.run(function, [job], lost)

    def _executor(self) -> Any:
        if self.client is not None:
            # Not pure: a job's key must not be taken for that of an earlier study that is still held.
            return self.client.get_executor(pure=False)
        # Spawned: threads of this process, which a fork would not take along, may hold locks. Ctrl-C, which a
        # terminal sends to every process, ends a worker without a traceback.
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(self.workers, context, signal.signal, (signal.SIGINT, signal.SIG_DFL))


@contextmanager
def scheduler_for(address: str | None, workers: int | None) -> Iterator[Scheduler]:
    """Open where to run: the cluster at `address`, that many processes here, or this process.

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
        needed = "a cluster needs dask[distributed]: pip install 'speckle3d[cluster]', got none installed"
        raise InvalidInputError(needed) from error
    except (OSError, ValueError) as error:
        raise FileError(f"{address}: expected a Dask scheduler, got none: {one_line(error)}") from error
    with client:
        if not client.nthreads():
            raise FileError(f"{address}: expected workers on the cluster, got none")
        yield Scheduler(client=client)


def _alone(function: Callable[[Job], Result], job: Job) -> Result:
    """Run a job on a worker, without a second thread."""
    with on_one_thread():
        return function(job)
