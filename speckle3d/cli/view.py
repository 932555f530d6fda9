"""Looking at a file in the browser."""

from __future__ import annotations

import webbrowser
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from speckle3d.cli.common import SweepFile, app, note
from speckle3d.core.errors import InvalidInputError


@app.command()
def view(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A recording, a reconstruction or its results folder, a log of an orientation sensor, or "
            "the serial port of one, as /dev/ttyUSB0 or COM3.",
        ),
    ],
    reconstruction: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Reconstruction of the recording, to see with it.")
    ] = None,
    sweep: SweepFile = None,
    record: Annotated[
        Path | None,
        typer.Option(metavar="OUT", help="Of a sensor on a port: new file for its bytes; else none is kept."),
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on this machine; 0: any free one.")] = 0,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the browser, or only print the address.")
    ] = True,
) -> None:
    """Look at a file in the browser, on this machine alone; ends ten minutes after the last viewer left."""
    if find_spec("panel") is None:
        raise InvalidInputError("view: expected Panel to be installed: pip install 'speckle3d[app]'")
    from speckle3d.app.opened import opened
    from speckle3d.app.server import AppServer

    with opened(file, record, reconstruction=reconstruction, sweep=sweep) as pages:
        server = AppServer(pages, file.name, port)
        note(server.address)
        if browser:
            webbrowser.open(server.address_for_once())
        server.run()
    note(f"{file}: no viewer for ten minutes: ended")
