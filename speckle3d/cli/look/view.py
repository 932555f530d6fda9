"""Looking at a file in the browser."""

import webbrowser
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any, Literal

from speckle3d.cli.commands import Fields
from speckle3d.cli.common import MaybePath, Port, WritablePath, note
from speckle3d.core.extras import require_extra

_SETTINGS = "speckle3d.calibrating.settings"
_SCAN = ("phantom", "points", "poses", "transform", "pixel_mm")
_IMPORTED = ("column_pitch_mm", "row_spacing_mm", "frame_rate_hz", "dynamic_range_db", "plus_config")


def view(
    file: Path,
    *,
    reconstruction: MaybePath = None,
    sweep_file: MaybePath = None,
    record: WritablePath = None,
    calibrate: Literal["plane", "orientation", "wires"] | None = None,
    scan: Annotated[Any, Fields(f"{_SETTINGS}:WireSettings", _SCAN)],
    plane: Annotated[Any, Fields(f"{_SETTINGS}:OrientationSettings", ("sensor", "level"))],
    recording: Annotated[Any, Fields("speckle3d.io.import_settings:ImportSettings", _IMPORTED)],
    port: Port = 0,
    browser: bool = True,
) -> None:
    """Look at a file in the browser, on this machine alone; ends ten minutes after the last viewer left.

    Parameters
    ----------
    file
        A recording, a reconstruction or its results folder, a log of an orientation sensor, or the serial
        port of one, as /dev/ttyUSB0 or COM3.
    reconstruction
        Reconstruction of the recording, to see with it.
    calibrate
        FILE shows a phantom: tune what is found in it and calibrate, as the command would. Not with
        --record or --reconstruction or --sweep.
    record
        Of a sensor on a port: new file for its bytes; else none is kept.
    port
        Port on this machine; 0: any free one.
    browser
        Open the browser, or only print the address.

    Other Parameters
    ----------------
    sweep_file
    phantom
        With --calibrate: of wires, cross (default), three, or a PLUS configuration of N-wires.
    points
        With --calibrate: of wires, CSV of points picked by hand, to go on from.
    sensor
        With --calibrate: of orientation, which sensor's (orientation).
    level
        With --calibrate: of orientation, the plane is level.
    poses
        With --calibrate: file with the sensor's readings, if not in FILE.
    transform
        With --calibrate: poses to use, by their name in an image sequence, as ToolToTracker (ProbeToTracker).
    pixel_mm
        With --calibrate: distance between columns and rows, mm, if FILE does not say.
    column_pitch_mm, row_spacing_mm, frame_rate_hz, dynamic_range_db, plus_config
        Of a recording that does not say it, as in `speckle3d convert`. Not with --calibrate.

    Examples
    --------
    $ speckle3d view out
    $ speckle3d view bath.h5 --calibrate plane
    """
    require_extra("app", "view", "panel")
    from speckle3d.app.opened import open_pages
    from speckle3d.app.phantom.pages import phantom_page
    from speckle3d.app.server import AppServer
    from speckle3d.calibrating.settings import model_of
    from speckle3d.io.toml import validated

    with ExitStack() as running:
        if calibrate is None:
            pages = running.enter_context(
                open_pages(file, record, reconstruction=reconstruction, sweep=sweep_file, settings=recording)
            )
        else:
            values = scan.model_dump(exclude_unset=True) | plane.model_dump(exclude_unset=True)
            pages = [phantom_page(file, validated(values, f"--calibrate {calibrate}", model_of(calibrate)))]
        server = AppServer(pages, file.name, port)
        note(server.address)
        if browser:
            webbrowser.open(server.address_for_once())
        server.run()
    note(f"{file}: no viewer for ten minutes: ended")
