"""Work in the background of which only the newest request counts."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

Request = TypeVar("Request")


class Newest(Generic[Request]):
    """One thread that works on the newest request; those that came before it and were not begun are dropped.

    The thread is there only while there is work, and does not keep the process from ending.

    Parameters
    ----------
    work : callable
        Of a request. It must not raise: there is nobody to tell.
    wait_s : float
        Time without another request before one is begun.
    """

    def __init__(self, work: Callable[[Request], None], wait_s: float = 0.0) -> None:
        self._work, self._wait_s = work, wait_s
        self._changed = threading.Condition()
        self._next: list[Request] = []
        self._is_at_work = False

    def ask(self, request: Request) -> None:
        """Ask for work, in place of what was asked for before."""
        with self._changed:
            self._next = [request]
            self._changed.notify()
            if not self._is_at_work:
                self._is_at_work = True
                threading.Thread(target=self._run, name="speckle3d-newest", daemon=True).start()

    @property
    def has_newer(self) -> bool:
        """Whether the work that is being done is not asked for any more."""
        return bool(self._next)

    def _run(self) -> None:
        while (request := self._taken()) is not None:
            self._work(request[0])

    def _taken(self) -> list[Request] | None:
        with self._changed:
            # Every new request begins the wait anew.
            while self._next and self._wait_s and self._changed.wait(self._wait_s):
                pass
            taken, self._next = self._next, []
            self._is_at_work = bool(taken)
            return taken or None
