"""Work that takes longer than a click: in a thread, with its progress shown."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import panel as pn
from bokeh.document import Document

from speckle3d.core.progress import Progress

Result = TypeVar("Result")

_POLL_S = 0.1


class Work:
    """A button whose work runs in a thread, and a bar for its progress.

    Parameters
    ----------
    button : pn.widgets.Button
        Cannot be clicked again while its work runs.
    """

    def __init__(self, button: pn.widgets.Button) -> None:
        self.button = button
        self.bar = pn.indicators.Progress(value=0, max=100, width=250, visible=False, margin=(14, 8))
        self._counted = (0, 0)

    def start(self, work: Callable[[Progress], Result], ended: Callable[[Result], Any]) -> None:
        """Do the work, which is given where to count frames done and frames in all; then show its result."""
        self._counted, self.bar.value = (0, 0), 0
        self.button.disabled, self.bar.visible = True, True
        pn.state.execute(partial(self._run, pn.state.curdoc, work, ended))

    async def _run(
        self,
        document: Document | None,
        work: Callable[[Progress], Result],
        ended: Callable[[Result], Any],
    ) -> None:
        task = asyncio.create_task(asyncio.to_thread(work, self._count))
        while not (await asyncio.wait({task}, timeout=_POLL_S))[0]:
            _later(document, self._show)
        _later(document, partial(self._ended, task, ended))

    def _count(self, done: int, total: int) -> None:
        self._counted = done, total

    def _show(self) -> None:
        done, total = self._counted
        self.bar.value = int(100 * done / total) if total else 0

    def _ended(self, task: asyncio.Task[Result], ended: Callable[[Result], Any]) -> None:
        self.button.disabled, self.bar.visible = False, False
        ended(task.result())


def in_turn(change: Callable[[], Any]) -> Callable[[object], None]:
    """Wrap what a widget's event changes: a figure may be changed in its viewer's turn alone."""
    return lambda event: _later(pn.state.curdoc, change)


def _later(document: Document | None, change: Callable[[], Any]) -> None:
    # In a notebook there are no turns.
    if document is None or document.session_context is None:
        change()
    else:
        document.add_next_tick_callback(change)
