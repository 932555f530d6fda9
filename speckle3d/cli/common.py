"""What the commands share: the application, its options, progress and output."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from speckle3d.core.errors import FileError, InvalidInputError

app = typer.Typer(
    name="speckle3d",
    help="Freehand 2-D ultrasound sweeps to measured 3-D.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
calibrate = typer.Typer(help="Calibrate what a reconstruction needs.", no_args_is_help=True)
app.add_typer(calibrate, name="calibrate")

Json = Annotated[bool, typer.Option("--json", help="Print machine-readable results on stdout.")]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="TOML with settings to change; see `speckle3d config`.")
]


@contextmanager
def progress_bar(what: str) -> Iterator[Any]:
    """A bar on stderr; yields a function of frames done and frames in all."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    # In a log a bar is noise, and an error must stay one line.
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@contextmanager
def naming_options() -> Iterator[None]:
    """Say of settings that pydantic refuses which command-line option they came from."""
    from pydantic import ValidationError

    try:
        yield
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"]).replace("_", "-")
        raise InvalidInputError(f"--{name}: {first['msg']}, got {first['input']!r}") from None


def note(text: str) -> None:
    """Say something on stderr, beside the results."""
    sys.stderr.write(text + "\n")


def emit(text: str) -> None:
    """Print results on stdout."""
    try:
        sys.stdout.write(text if text.endswith("\n") else text + "\n")
        sys.stdout.flush()
    except OSError as error:
        raise FileError(f"standard output: cannot be written: {error.strerror}") from error
