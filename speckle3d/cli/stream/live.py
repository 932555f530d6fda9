"""Reconstructing a sweep while it is made."""

from __future__ import annotations

import signal
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from speckle3d.cli.common import CalibrationFiles, ConfigFile, app, emit, load_settings, note
from speckle3d.cli.importing import Importing, Number
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.extras import require_extra
from speckle3d.core.printable import printable
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

    from speckle3d.config import Config
    from speckle3d.core.curves import DecorrelationCurves
    from speckle3d.io.igtl.link import LinkState
    from speckle3d.live.crossing import CrossingCheck
    from speckle3d.live.progress import Progress
    from speckle3d.live.session import Session

_LOG_EVERY_S = 5.0
_SILENT_S = 2.0
"""After which a connection on which nothing comes is told of."""
_ENDS = ("SIGINT", "SIGTERM", "SIGHUP")
_SWITCH_S = 5e-4
"""For which one thread keeps the interpreter at most; Python's 5 ms a frame would wait for many times."""


@app.command(cls=Importing)
def live(
    server: Annotated[
        str, typer.Argument(metavar="HOST:PORT", help="OpenIGTLink server, as PLUS; its port is 18944.")
    ],
    out: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for sweep.h5, as it is received, and the results.")
    ],
    curves_file: Annotated[Path, typer.Option("--curves", help="Decorrelation curves of this probe.")],
    image: Annotated[
        str | None, typer.Option(metavar="NAME", help="Device of the IMAGE messages; by default the first.")
    ] = None,
    transform: Annotated[
        str | None, typer.Option(metavar="NAME", help="Device of a tracker's TRANSFORM messages.")
    ] = None,
    orientation: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Device of TRANSFORM messages of which the rotation counts."),
    ] = None,
    calibration: CalibrationFiles = None,
    sampling_rate_hz: Number = None,
    vector_pitch_mm: Number = None,
    speed_of_sound_m_s: Number = None,
    centre_frequency_hz: Number = None,
    bandwidth_hz: Annotated[tuple[float, float] | None, typer.Option()] = None,
    first_sample_depth_mm: Number = None,
    column_pitch_mm: Annotated[
        float | None, typer.Option(help="Distance between columns of B-mode; by default the message's.")
    ] = None,
    row_spacing_mm: Annotated[
        float | None, typer.Option(help="Distance between rows of B-mode; by default the message's.")
    ] = None,
    dynamic_range_db: Number = None,
    probe: Annotated[
        str | None, typer.Option(metavar="MODEL", help="Model of the probe, as in the curves.")
    ] = None,
    serve: Annotated[
        int | None,
        typer.Option(metavar="PORT", min=0, max=65535, help="Serve poses and volume to others, too; 0: any."),
    ] = None,
    volume: Annotated[
        bool, typer.Option("--volume/--no-volume", help="Send the growing volume about once a second.")
    ] = True,
    check: Annotated[
        bool, typer.Option("--check", help="Say what to do: too fast, lifted, not overlapping, turn more.")
    ] = False,
    crossing_file: Annotated[
        Path | None, typer.Option("--crossing", metavar="FIRST", help="First sweep, which this one crosses.")
    ] = None,
    drift: Annotated[list[str] | None, typer.Option(help="Correction mode at the end; repeatable.")] = None,
    compression: Annotated[str, typer.Option(help="Of the recording: none, or gzip.")] = "none",
    duration_s: Annotated[float | None, typer.Option(min=0.0, help="End after so long.")] = None,
    config_file: ConfigFile = None,
) -> None:
    """Reconstruct a sweep while it is made: receive, record, place each frame, send its pose back.

    The pose is a TRANSFORM, ImageToReference, from the received image's pixels to mm; the growing volume an
    IMAGE, Volume_Reference; words of --check a STRING and a STATUS, SweepAdvice. Ctrl-C ends the sweep, which
    is then reconstructed as `speckle3d reconstruct` does it.
    """
    require_extra("live", "live", "pyigtl", "fastcrc")
    from speckle3d.cli.common import from_options
    from speckle3d.io.curves import read_curves
    from speckle3d.io.igtl.connection import Connection
    from speckle3d.io.igtl.server import Server
    from speckle3d.io.import_settings import ImportSettings
    from speckle3d.live.session import Session, SessionSettings
    from speckle3d.live.warming import warm_up
    from speckle3d.study.job import require_own_results

    options = locals()
    host, port = _address(server)
    if compression not in ("none", "gzip"):
        raise InvalidInputError(f"--compression: expected none or gzip, got {compression!r}")
    config, curves = load_settings(config_file), read_curves(curves_file)
    _require_possible(options)
    recorded = out / "sweep.h5"
    if recorded.exists():
        raise InvalidInputError(f"{recorded}: there already; expected a folder without a recorded sweep")
    require_own_results(out)
    out.mkdir(parents=True, exist_ok=True)
    settings = SessionSettings(
        recorded,
        image,
        transform,
        orientation,
        from_options(ImportSettings, options),
        config,
        volume,
        check,
        compression == "gzip",
    )
    note("loading")
    warm_up(curves, config)
    first = None if crossing_file is None else _first_sweep(crossing_file, curves, config)
    with ExitStack() as open_:
        served = None if serve is None else open_.enter_context(Server(serve))
        if served is not None:
            note(f"poses and volume at 127.0.0.1:{served.port}")
        connection = open_.enter_context(Connection(host, port))
        outlets = [connection.send] if served is None else [connection.send, served.send]
        note(f"listening to {server}")
        session = Session(connection, outlets, curves, settings, first)
        _run(session, duration_s, _Line(lambda: _trouble(connection.state, server)))
        if not session.progress.recorded:
            reasons = filter(None, (session.progress.missing, _trouble(connection.state, server)))
            raise InvalidInputError(f"{server}: no images came: {'; '.join(reasons) or 'none was sent'}")
    _reconstruct(session, recorded, curves, out, options)
    if session.failure is not None:
        raise session.failure


def _address(server: str) -> tuple[str, int]:
    host, colon, port = server.rpartition(":")
    if not (colon and host and port.isascii() and port.isdecimal() and 0 < int(port) < 2**16):
        raise InvalidInputError(f"expected HOST:PORT, as localhost:18944, got {server!r}")
    return host.strip("[]"), int(port)


def _require_possible(options: dict[str, Any]) -> None:
    """Refuse now what the reconstruction at the end would refuse for want of an option."""
    from speckle3d.io.calibrations import read_calibration
    from speckle3d.study.request import SUBSET

    tracker, sensors = ("transform",), ("transform", "orientation")
    needs = {"pose": tracker, "orientation": sensors, SUBSET: sensors, "crossed": ("crossing_file",)}
    needs["fused"] = (*sensors, "crossing_file")
    for mode in options["drift"] or ():
        if mode not in needs:
            raise InvalidInputError(f"--drift: expected one of {', '.join(needs)}, got {mode!r}")
        if not any(options[each] for each in needs[mode]):
            wanted = " or ".join(f"--{each.removesuffix('_file')}" for each in needs[mode])
            raise InvalidInputError(f"--drift {mode}: expected {wanted} beside it, got none")
    for path in options["calibration"] or ():
        name = "transform" if read_calibration(path).sensor == "tracker" else "orientation"
        if not options[name]:
            raise InvalidInputError(f"{path}: expected --{name} beside it, which it is for, got none")


def _trouble(state: LinkState, server: str) -> str:
    """What is wrong with a connection; empty if nothing is."""
    told = []
    if not state.connected:
        told.append(f"waiting for {server}" + (f" ({state.last_failure})" if state.last_failure else ""))
    elif state.silent_s > _SILENT_S:
        told.append(f"nothing comes from {server}")
    if state.refused:
        told.append(f"{state.refused} messages refused ({state.last_refused})")
    return ", ".join(told)


def _first_sweep(path: Path, curves: DecorrelationCurves, config: Config) -> CrossingCheck:
    from speckle3d.io.load import load_sweep
    from speckle3d.live.crossing import CrossingCheck

    with progress_bar(f"tracking {path.name}") as progress:
        return CrossingCheck.of(load_sweep(path), curves, config, progress)


def _run(session: Session, duration_s: float | None, line: _Line) -> None:
    """Run until Ctrl-C, or for so long; other signals that ask for the end are heard once all is recorded."""
    heard: list[int] = []

    def end(number: int, _frame: FrameType | None) -> None:
        heard.append(number)
        session.end()

    numbers = [getattr(signal, name) for name in _ENDS if hasattr(signal, name)]
    before = {each: was for each in numbers if (was := signal.getsignal(each)) is not signal.SIG_IGN}
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    for each in before:
        signal.signal(each, end)
    try:
        session.run(duration_s, line.show)
    finally:
        sys.setswitchinterval(interval_s)
        for each, was in before.items():
            signal.signal(each, was)
        line.end()
    for each in heard:
        if each != signal.SIGINT:
            signal.raise_signal(each)


class _Line:
    """The line that is looked at: in place on a terminal, in a log now and then and with other words.

    Parameters
    ----------
    trouble : callable
        Says what is wrong with the connection; empty if nothing is.
    """

    def __init__(self, trouble: Callable[[], str]) -> None:
        self._trouble, self._is_terminal = trouble, sys.stderr.isatty()
        self._told_s, self._words, self._last = 0.0, "", ""

    def show(self, progress: Progress) -> None:
        """Show how it goes."""
        text = " | ".join(filter(None, (progress.line, self._trouble())))
        now = time.monotonic()
        if self._is_terminal:
            sys.stderr.write(f"\r\x1b[K{printable(text)[: _columns()]}")
            sys.stderr.flush()
        elif progress.words != self._words or (now - self._told_s > _LOG_EVERY_S and text != self._last):
            note(text)
            self._told_s, self._words, self._last = now, progress.words, text

    def end(self) -> None:
        """Leave the line."""
        if self._is_terminal:
            sys.stderr.write("\n")


def _columns() -> int:
    import shutil

    return shutil.get_terminal_size().columns - 1


def _reconstruct(
    session: Session, recorded: Path, curves: DecorrelationCurves, out: Path, options: dict[str, Any]
) -> None:
    """Reconstruct what was recorded, as `speckle3d reconstruct` does."""
    from speckle3d.io.load import load_sweep
    from speckle3d.study.job import run_job

    done = session.progress
    if done.recorded < 2:
        raise InvalidInputError(f"{recorded}: expected two images to reconstruct, got {done.recorded}")
    left = f"; {done.left} were left for now" if done.left else ""
    note(f"{done.recorded} frames in {recorded}, {done.matched} placed as they came{left}")
    if done.missing:
        note(done.missing)
    crossing = options["crossing_file"]
    modes = list(dict.fromkeys(options["drift"] or ()))
    if crossing is not None and not {"crossed", "fused"}.intersection(modes):
        modes.append("crossed")
    with progress_bar(f"reconstructing {recorded.name}") as progress:
        result = run_job(
            load_sweep(recorded),
            recorded,
            curves,
            out,
            modes,
            config=load_settings(options["config_file"]),
            progress=progress,
            calibrations=options["calibration"] or (),
            crossing=None if crossing is None else (load_sweep(crossing), crossing),
        )
    emit(result.table)
    note(f"{done.recorded} frames; results in {result.directory}")
