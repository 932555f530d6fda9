"""How far a long piece of work has come: told to a callable, shown as rich's bar."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from speckle3d.core.printable import printable

Progress = Callable[[int, int], None]
"""Called with what is done and what there is in all, frames or the like."""


def after(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Progress of one of several sweeps, `before` frames of `total` being done when it begins."""
    return None if progress is None else lambda done, _: progress(before + done, total)


@contextmanager
def progress_bar(what: str) -> Iterator[Progress]:
    """Show a bar while something is done, in a terminal on stderr, in a notebook below the cell.

    Parameters
    ----------
    what : str
        Shown before the bar.

    Yields
    ------
    callable
        For the parameter `progress` of `speckle3d.track` and others: to be called with what is done and what
        there is in all.

    Examples
    --------
    >>> import speckle3d as s3
    >>> sweep, curves = s3.load_sweep("data/phantom.h5"), s3.load_curves("data/curves.h5")  # doctest: +SKIP
    >>> with s3.progress_bar("tracking") as told:  # doctest: +SKIP
    ...     tracked = s3.track(sweep, curves, progress=told)
    """
    from rich.progress import MofNCompleteColumn, TimeRemainingColumn

    with bar_on_stderr(what, MofNCompleteColumn(), TimeRemainingColumn()) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@contextmanager
def bar_on_stderr(what: str, *columns: Any) -> Iterator[Any]:
    """Show rich's progress under a description on stderr, with more columns behind the bar."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True)
    # In a log a bar is noise, and an error must stay one line.
    hidden = not (console.is_terminal or console.is_jupyter)
    # The name of a file is neither markup nor a template.
    name = printable(what).replace("{", "{{").replace("}", "}}")
    shown = (TextColumn(name, markup=False), BarColumn(), *columns)
    with Progress(*shown, console=console, transient=True, disable=hidden) as bar:
        yield bar
