"""Work that takes longer than a click: in a thread, with its progress shown."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import panel as pn
from bokeh.document import Document

Result = TypeVar("Result")
Progress = Callable[[int, int], None]

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

    async def run(self, work: Callable[[Progress], Result], ended: Callable[[Result], Any]) -> None:
        """Do the work, which is given where to count frames done and frames in all; then show its result."""
        document = pn.state.curdoc
        self._counted, self.bar.value = (0, 0), 0
        self.button.disabled, self.bar.visible = True, True
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


def _later(document: Document | None, change: Callable[[], None]) -> None:
    """Change what a viewer sees when it is the viewer's turn: after a wait, it no longer is."""
    if document is None:
        change()
    else:
        document.add_next_tick_callback(change)
