"""A recorded sweep served as a scanner would, for trying Slicer or `speckle3d live` without one."""

from __future__ import annotations

import sys
import time
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from speckle3d.cli.common import Images, app, note
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.extras import require_extra

if TYPE_CHECKING:
    from speckle3d.core.sweep import Frames, ImageGrid, Sweep
    from speckle3d.io.igtl.server import Server

_TELL_S = 1.0
_LAST_S = 5.0
"""Longest wait for a client to take what is left at the end."""


class Kind(StrEnum):
    """What is sent of a sweep's frames."""

    RF = "rf"
    BMODE = "bmode"


@app.command()
def play(
    sweep: Images,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free one.")] = 18944,
    address: Annotated[str, typer.Option(help="0.0.0.0: also for other machines.")] = "127.0.0.1",
    rate: Annotated[float, typer.Option(min=1e-3, max=1e3, help="Speed, times the sweep's own.")] = 1.0,
    kind: Annotated[
        Kind | None, typer.Option("--as", help="Echoes (default, of RF or I/Q) or B-mode made of them.")
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end, until Ctrl-C.")] = False,
    image: Annotated[
        str, typer.Option(metavar="NAME", help="Device of the IMAGE messages.")
    ] = "Image_Reference",
    transform: Annotated[
        str, typer.Option(metavar="NAME", help="Device of the tracker's TRANSFORM messages.")
    ] = "ProbeToReference",
    orientation: Annotated[
        str, typer.Option(metavar="NAME", help="Device of the orientation sensor's TRANSFORM messages.")
    ] = "ProbeToWorld",
) -> None:
    """Serve a recorded sweep over OpenIGTLink at its own rate, as PLUS serves a scanner.

    It begins when the first client connects. Messages carry the sweep's own times, shifted if some are below
    zero. RF is sent with the samples of a vector along the columns, as PLUS sends it; the readings of a
    tracker or an orientation sensor are TRANSFORM messages.
    """
    require_extra("live", "play", "pyigtl", "fastcrc")
    from speckle3d.io.igtl.played import Names, clock_shift_s, played
    from speckle3d.io.igtl.server import Server
    from speckle3d.io.load import load_sweep

    read = load_sweep(sweep)
    frames, grid, upright = _frames(read, kind)
    names = Names(image, transform, orientation)
    shift_s, round_s = clock_shift_s(read), _round_s(read)
    next(played(read, frames, grid, upright, names, shift_s))  # refused at once if messages cannot hold it
    if shift_s:
        note(f"times in the messages are the sweep's and {shift_s:g} s")
    with Server(port, address) as server:
        note(f"{address}:{server.port}: {len(read)} frames of {read.name}; waiting for a client")
        while not server.wait_connected(1.0):
            server.receive(0.0)
        sent, player = 0, _Player(server, rate)
        for turn in range(sys.maxsize if loop else 1):
            for each in played(read, frames, grid, upright, names, shift_s + turn * round_s):
                player.send(turn * round_s + each.at_s, each.message)
                sent += each.is_frame
                player.tell(sent)
        server.drain(_LAST_S)
        player.tell(sent, last=True)


def _frames(sweep: Sweep, kind: Kind | None) -> tuple[Frames, ImageGrid, bool]:
    """What is sent, where it lies, and whether its vectors are columns."""
    from speckle3d.core.sweep import BModeSettings
    from speckle3d.study.images import grey_images

    is_grey = isinstance(sweep.signal, BModeSettings)
    is_stored = is_grey and sweep.frames.dtype == "uint8"
    if kind is Kind.RF and is_grey:
        raise InvalidInputError(f"--as rf: expected echoes, got {sweep.name}, which holds B-mode")
    if is_grey or kind is Kind.BMODE:
        images = grey_images(sweep, levels="stored" if is_stored else "log")
        return images, images.grid, True
    return sweep.frames, sweep.grid, False


def _round_s(sweep: Sweep) -> float:
    """Time from a sweep's beginning to that of its next turn."""
    times = sweep.frame_time_s
    return float(times[-1] - times[0] + (times[-1] - times[-2] if len(times) > 1 else 1.0))


class _Player:
    """Sends messages when they are due, and tells of it once a second."""

    def __init__(self, server: Server, rate: float) -> None:
        self._server, self._rate = server, rate
        self._start_s = time.monotonic()
        self._told_s = self._start_s

    def send(self, at_s: float, message: bytes) -> None:
        """Send a message when it is due."""
        time.sleep(max(0.0, self._start_s + at_s / self._rate - time.monotonic()))
        self._server.send(message)

    def tell(self, sent: int, last: bool = False) -> None:
        """Say how many frames were sent."""
        now = time.monotonic()
        if last or now - self._told_s >= _TELL_S:
            self._told_s = now
            self._server.receive(0.0)
            state = self._server.state
            dropped = f", {state.dropped} messages dropped: a client is too slow" if state.dropped else ""
            note(f"{sent} frames sent to {self._server.clients} client(s){dropped}")
