"""Sweeps over OpenIGTLink: reconstructing one while it is made, and serving one as a scanner would."""

from __future__ import annotations

import re
import signal
import sys
import time
import webbrowser
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

import speckle3d as s3
from speckle3d.cli.commands import Fields
from speckle3d.cli.common import (
    Drift,
    MaybeNumber,
    MaybePath,
    MaybeText,
    Out,
    Paths,
    Port,
    note,
    status_line,
)
from speckle3d.cli.reconstruction import reconstruct
from speckle3d.cli.signals import handle_ends
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.extras import require_extra

if TYPE_CHECKING:
    from types import FrameType

    from speckle3d.io.igtl.link import Connection, End
    from speckle3d.live.progress import Progress
    from speckle3d.live.session import Session

_SILENT_S = 2.0
"""After which a connection on which nothing comes is told of."""
_LEFT_S = 10.0
"""After which a server that sent images and left does not come back; PLUS is started again in less."""
_LAST_LOOK_S = 1.0
"""For pages to show the end."""
_SWITCH_S = 5e-4
"""For which one thread keeps the interpreter at most; Python's 5 ms a frame would wait for many times."""
_SETTINGS = (
    "sampling_rate_hz",
    "vector_pitch_mm",
    "speed_of_sound_m_s",
    "centre_frequency_hz",
    "bandwidth_hz",
    "first_sample_depth_mm",
    "column_pitch_mm",
    "row_spacing_mm",
    "dynamic_range_db",
    "probe",
)


def live(
    server: Annotated[str, typer.Argument(metavar="HOST:PORT")],
    out: Out,
    *,
    curves_file: Annotated[Path, typer.Option()],
    image: MaybeText = None,
    transform: MaybeText = None,
    orientation: MaybeText = None,
    calibration: Paths = None,
    importing: Annotated[Any, Fields("speckle3d.io.import_settings:ImportSettings", _SETTINGS)],
    view: bool = False,
    serve: Annotated[int | None, typer.Option(min=0, max=65535)] = None,
    volume: bool = True,
    check: bool = False,
    crossing_file: MaybePath = None,
    region: MaybeText = None,
    drift: list[Drift] | None = None,
    duration_s: MaybeNumber = None,
    config_file: MaybePath = None,
) -> None:
    """Reconstruct a sweep while it is made: receive, record, place each frame, send its pose back.

    The pose is a TRANSFORM, ImageToReference, from the received image's pixels to mm; the growing volume an
    IMAGE, Volume_Reference; words of --check a STRING and a STATUS, SweepAdvice. Ctrl-C ends the sweep, or
    the server that is gone for ten seconds; it is then reconstructed as `speckle3d reconstruct` does it.

    Parameters
    ----------
    server
        OpenIGTLink server, as PLUS; its port is 18944.
    out
        Folder for sweep.h5, as it is received, and the results.
    curves_file
        Decorrelation curves of this probe.
    transform
        Device of a tracker's TRANSFORM messages.
    orientation
        Device of TRANSFORM messages of which the rotation counts.
    calibration
    drift
        Mode at the end beside image; may be repeated.
    check
        Say what to do: too fast, lifted, not overlapping, turn more.
    view
        Show the picture, the length so far, the path and the growing volume in the browser.
    volume
        Send the growing volume about once a second.

    Other Parameters
    ----------------
    image
        Device of the IMAGE messages; by default the first.
    serve
        Serve poses and volume to others, too; 0: any free port.
    crossing_file
        First sweep, which this one crosses.
    region
        Part of the image to look at, in mm: 'rectangle x,y x,y', 'polygon x,y x,y x,y ...' or 'fan x,y
        angle,angle radius,radius'; several joined by ' and '.
    duration_s
        End after so long.

    Examples
    --------
    $ speckle3d live localhost:18944 -o out --curves curves.h5 --check
    """
    require_extra("live", "live", "pyigtl", "fastcrc")
    if view:
        require_extra("app", "live --view", "panel")
        from speckle3d.app.live import watch
    from speckle3d.io.igtl.link import Connection, Server
    from speckle3d.live.crossing import CrossingCheck
    from speckle3d.live.session import Session, SessionSettings
    from speckle3d.live.warming import warm_up
    from speckle3d.study.job import RESULTS
    from speckle3d.study.results import require_own

    match = re.fullmatch(r"\[?(.+?)\]?:([0-9]{1,5})", server)
    if match is None or not 0 < int(match[2]) < 2**16:
        raise InvalidInputError(f"expected HOST:PORT, as localhost:18944, got {server!r}")
    config, curves = s3.load_config(config_file).with_choices(region=region), s3.load_curves(curves_file)
    recording = out / "sweep.h5"
    if recording.exists():
        raise InvalidInputError(f"{recording}: there already; expected a folder without a recorded sweep")
    require_own(out, RESULTS)
    settings = SessionSettings(recording, image, transform, orientation, importing, config, volume, check)
    note("loading")
    warm_up(curves, config)
    first = None
    if crossing_file is not None:
        with s3.progress_bar(f"tracking {crossing_file.name}") as progress:
            first = CrossingCheck(s3.load_sweep(crossing_file), curves, config, progress)
    with ExitStack() as pages, ExitStack() as links:
        relay = None if serve is None else links.enter_context(Server(serve))
        if relay is not None:
            note(f"poses and volume at 127.0.0.1:{relay.port}")
        connection = links.enter_context(Connection(match[1], int(match[2])))
        outlets = [connection.send] if relay is None else [connection.send, relay.send]
        note(f"listening to {server}")
        session, ends = Session(connection, outlets, curves, settings, first), list[str]()
        if view:
            address, address_for_once = pages.enter_context(
                watch(session, lambda: ends[-1] if ends else _trouble(connection, server))
            )
            note(address)
            webbrowser.open(address_for_once)
        _run(session, duration_s, connection, server)
        totals = session.progress
        ends.append(f"the sweep has ended; reconstructing it into {out} ...")
        if not totals.frames:
            reasons = filter(None, (totals.missing, _trouble(connection, server)))
            raise InvalidInputError(f"{server}: no images came: {'; '.join(reasons) or 'none was sent'}")
        links.close()
        note(f"{totals.frames} frames in {recording}, {totals.poses} placed as they came")
        if totals.missing:
            note(totals.missing)
        reconstruct(
            recording,
            out,
            curves_file,
            drift,
            crossing_file,
            region=region,
            calibration=calibration,
            config_file=config_file,
        )
        ends.append(f"the sweep has ended; its results: speckle3d view {out}")
        if view:
            time.sleep(_LAST_LOOK_S)
    if session.failure is not None:
        raise session.failure


def _trouble(server: End, name: str) -> str:
    """Trouble of a server in words; empty if there is none."""
    words = []
    if not server.peers:
        why = f" ({server.last_failure})" if server.last_failure else ""
        words.append(f"waiting for {name}{why}")
    elif server.silent_s > _SILENT_S:
        words.append(f"nothing comes from {name}")
    if server.refused:
        words.append(f"{server.refused} messages refused ({server.last_refused})")
    return ", ".join(words)


def _run(session: Session, duration_s: float | None, connection: Connection, name: str) -> None:
    """Run until Ctrl-C, for so long, or until the server has left.

    Other signals that ask for the end are heard once all is recorded. How it goes is a line in place on a
    terminal; a log has it when there is something else to say.
    """
    signals, last_note = list[int](), ""

    def show(progress: Progress) -> None:
        nonlocal last_note
        trouble = _trouble(connection, name)
        text = " | ".join(filter(None, (progress.line, trouble)))
        show_line(text)
        if not sys.stderr.isatty() and (words := f"{progress.words}{trouble}") != last_note:
            note(text)
            last_note = words
        if progress.frames and not connection.peers and connection.silent_s > _LEFT_S:
            note(f"{trouble}: taken for the end of the sweep")
            session.end()

    def end(number: int, _frame: FrameType | None) -> None:
        signals.append(number)
        session.end()

    sys.setswitchinterval(_SWITCH_S)
    with handle_ends(end), status_line() as show_line:
        session.run(duration_s, show)
    for number in signals:
        if number != signal.SIGINT:
            signal.raise_signal(number)


_LAST_S = 5.0
"""Longest wait for a client to take what is left at the end."""


def play(
    images: Path,
    port: Port = 18944,
    rate: Annotated[float, typer.Option(min=1e-3, max=1e3)] = 1.0,
    kind: Annotated[Literal["rf", "bmode"] | None, typer.Option("--as")] = None,
) -> None:
    """Serve a recorded sweep over OpenIGTLink at its own rate, as PLUS serves a scanner.

    It begins when the first client connects. Messages carry the sweep's own times, shifted if some are below
    zero. RF is sent with the samples of a vector along the columns, as PLUS sends it. Devices are
    Image_Reference, and ProbeToReference and ProbeToWorld of a tracker's and an orientation sensor's poses.

    Parameters
    ----------
    images
    port
        0: any free one.
    kind
        Echoes (default, of RF or I/Q of parallel vectors) or B-mode made of them.
    rate
        Speed, times the sweep's own.

    Examples
    --------
    $ speckle3d play sweep.h5
    """
    require_extra("live", "play", "pyigtl", "fastcrc")
    from speckle3d.core.sweep import BModeSettings
    from speckle3d.io.igtl.link import Server
    from speckle3d.live.played import clock_shift_s, played

    read = s3.load_sweep(images)
    is_grey = isinstance(read.signal, BModeSettings)
    has_echoes = not is_grey and read.grid.fan is None
    if kind == "rf" and not has_echoes:
        raise InvalidInputError(f"--as rf: expected echoes of parallel vectors, got {read.name}")
    send = partial(played, read, read.frames, read.grid, False)
    if kind == "bmode" or not has_echoes:
        greys = s3.grey_images(read, levels="stored" if is_grey else "log")
        send = partial(played, read, greys, greys.grid, True)
    shift_s = clock_shift_s(read)
    next(send(shift_s))  # refused at once if messages cannot hold it
    if shift_s:
        note(f"times in the messages are the sweep's and {shift_s:g} s")
    with Server(port) as server, s3.progress_bar(f"playing {read.name}") as progress:
        note(f"127.0.0.1:{server.port}: {len(read)} frames of {read.name}; waiting for a client")
        while not server.peers:
            server.receive(0.02)
        count, start_s = 0, time.monotonic()
        for at_s, message, is_frame in send(shift_s):
            time.sleep(max(0.0, start_s + at_s / rate - time.monotonic()))
            server.send(message)
            server.receive(0.0)
            count += is_frame
            progress(count, len(read))
        server.drain(_LAST_S)
        losses = server.dropped
        slow = f", {losses} messages dropped: a client is too slow" if losses else ""
        note(f"{count} frames sent{slow}")
