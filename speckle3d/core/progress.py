"""Progress of long work, reported to a callable and shown as a progress bar."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from speckle3d.core.text import printable

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
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    # The name of a file is no markup.
    name = TextColumn("{task.description}", markup=False)
    columns = (name, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    # In a log a bar is noise, and an error must stay one line.
    hidden = not (console.is_terminal or console.is_jupyter)
    with Progress(*columns, console=console, transient=True, disable=hidden) as bar:
        task = bar.add_task(printable(what), total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
