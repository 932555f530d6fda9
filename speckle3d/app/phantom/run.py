"""Work of a page in a thread, and sentences on what came of it."""

from __future__ import annotations

import asyncio
import html
from collections.abc import Callable
from typing import TypeVar

from panel.widgets import Button

_Result = TypeVar("_Result")


async def run_in_thread(button: Button, work: Callable[[], _Result]) -> _Result:
    """Do work in a thread; the button turns and cannot be clicked meanwhile."""
    button.disabled = button.loading = True
    try:
        return await asyncio.to_thread(work)
    finally:
        button.disabled = button.loading = False


def sentence(words: str, colour: str, name: str = "verdict") -> str:
    """HTML of a sentence."""
    return f"<div class='{name}' style='color:{colour};font-weight:600'>{html.escape(words)}</div>"
