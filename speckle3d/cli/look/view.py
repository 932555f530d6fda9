"""Looking at a file in the browser."""

from __future__ import annotations

import webbrowser
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from speckle3d.cli.common import PixelMm, Poses, SweepFile, Transform, app, from_options, note
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.extras import require_extra

if TYPE_CHECKING:
    from speckle3d.app.page import Page
    from speckle3d.io.import_settings import ImportSettings


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
    calibrate: Annotated[
        Literal["plane", "orientation", "wires"] | None,
        typer.Option(
            help="FILE shows a phantom: tune what is found in it and calibrate, as the command would."
        ),
    ] = None,
    phantom: Annotated[
        str, typer.Option(help="Wires: cross, three, or a PLUS configuration of N-wires.")
    ] = "cross",
    points: Annotated[
        Path | None, typer.Option(help="Wires: CSV of points picked by hand, to go on from.")
    ] = None,
    poses: Poses = None,
    transform: Transform = None,
    pixel_mm: PixelMm = None,
    dynamic_range_db: Annotated[
        float | None, typer.Option(help="Of a recording's grey levels, if it does not say.")
    ] = None,
    sensor: Annotated[
        Literal["orientation", "tracker"], typer.Option(help="Orientation: which sensor's.")
    ] = "orientation",
    level: Annotated[bool, typer.Option("--level", help="Orientation: the plane is level.")] = False,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on this machine; 0: any free one.")] = 0,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the browser, or only print the address.")
    ] = True,
) -> None:
    """Look at a file in the browser, on this machine alone; ends ten minutes after the last viewer left."""
    require_extra("app", "view", "panel")
    from speckle3d.app.opened import opened
    from speckle3d.app.server import AppServer

    with ExitStack() as running:
        if calibrate is None:
            _require_no_phantom(locals())
            given = _settings(pixel_mm, dynamic_range_db)
            pages = running.enter_context(
                opened(file, record, reconstruction=reconstruction, sweep=sweep, settings=given)
            )
        else:
            _require_phantom_alone(record, reconstruction, sweep)
            pages = _phantom(file, calibrate, locals())
        server = AppServer(pages, file.name, port)
        note(server.address)
        if browser:
            webbrowser.open(server.address_for_once())
        server.run()
    note(f"{file}: no viewer for ten minutes: ended")


_OF_PHANTOMS = ("phantom", "points", "poses", "transform", "pixel_mm", "sensor", "level")
_OF_RECORDINGS = ("pixel_mm",)
"""Those that serve without a phantom, too."""


def _settings(pixel_mm: tuple[float, float] | None, dynamic_range_db: float | None) -> ImportSettings:
    """What a recording does not say, for looking at it."""
    from speckle3d.io.import_settings import ImportSettings

    column_mm, row_mm = pixel_mm or (None, None)
    options = {
        "column_pitch_mm": column_mm,
        "row_spacing_mm": row_mm,
        "dynamic_range_db": dynamic_range_db,
    }
    return from_options(ImportSettings, options)


def _require_no_phantom(options: Mapping[str, Any]) -> None:
    """Refuse options of phantoms without `--calibrate`, which they go with."""
    plain = {"phantom": "cross", "sensor": "orientation", "level": False}
    names = [name for name in _OF_PHANTOMS if name not in _OF_RECORDINGS]
    given = [name for name in names if options[name] != plain.get(name)]
    if given:
        option = given[0].replace("_", "-")
        raise InvalidInputError(
            f"--{option}: expected --calibrate plane, orientation or wires with it, got none"
        )


def _require_phantom_alone(*others: Path | None) -> None:
    """Refuse files that go with recordings and sensors beside `--calibrate`."""
    for name, other in zip(("record", "reconstruction", "sweep"), others, strict=True):
        if other is not None:
            raise InvalidInputError(f"--{name}: expected none beside --calibrate, got {other}")


def _phantom(file: Path, method: str, options: Mapping[str, Any]) -> Sequence[Page]:
    from speckle3d.app.phantom.pages import phantom_pages
    from speckle3d.calibrating.settings import model_of

    model = model_of(method)
    given = {name: options[name] for name in _OF_PHANTOMS if name in model.model_fields}
    return phantom_pages(file, from_options(model, given))
