"""A recorded sweep served as a scanner would, for trying Slicer or `speckle3d live` without one."""

from __future__ import annotations

import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from speckle3d.cli.common import Port, note
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.extras import require_extra
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from speckle3d.core.grid import ImageGrid
    from speckle3d.core.sweep import Frames, Sweep

Kind = Literal["rf", "bmode"]

_DEVICES = "Image_Reference", "ProbeToReference", "ProbeToWorld"
_LAST_S = 5.0
"""Longest wait for a client to take what is left at the end."""


def play(
    images: Path,
    port: Port = 18944,
    address: str = "127.0.0.1",
    rate: Annotated[float, typer.Option(min=1e-3, max=1e3)] = 1.0,
    kind: Annotated[Kind | None, typer.Option("--as")] = None,
    loop: bool = False,
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
        Echoes (default, of RF or I/Q) or B-mode made of them.
    rate
        Speed, times the sweep's own.
    loop
        Begin again at the end, until Ctrl-C.

    Other Parameters
    ----------------
    address
        0.0.0.0: also for other machines.

    Examples
    --------
    $ speckle3d play sweep.h5 --loop
    """
    require_extra("live", "play", "pyigtl", "fastcrc")
    from speckle3d.io.igtl.link import Server
    from speckle3d.io.igtl.played import clock_shift_s, played
    from speckle3d.io.load import load_sweep

    read = load_sweep(images)
    frames, grid, upright = _frames(read, kind)
    send = partial(played, read, frames, grid, upright, _DEVICES)
    times, shift_s = read.frame_time_s, clock_shift_s(read)
    round_s = float(times[-1] - times[0] + (times[-1] - times[-2] if len(times) > 1 else 1.0))
    next(send(shift_s))  # refused at once if messages cannot hold it
    if shift_s:
        note(f"times in the messages are the sweep's and {shift_s:g} s")
    with Server(port, address) as server, progress_bar(f"playing {read.name}") as progress:
        note(f"{address}:{server.port}: {len(read)} frames of {read.name}; waiting for a client")
        while not server.wait_connected(1.0):
            server.receive(0.0)
        count, start_s = 0, time.monotonic()
        for turn in range(sys.maxsize if loop else 1):
            for at_s, message, is_frame in send(shift_s + turn * round_s):
                due_s = start_s + (turn * round_s + at_s) / rate
                time.sleep(max(0.0, due_s - time.monotonic()))
                server.send(message)
                server.receive(0.0)
                count += is_frame
                progress(count, len(read) * (turn + 1))
        server.drain(_LAST_S)
        losses = server.state.dropped
        slow = f", {losses} messages dropped: a client is too slow" if losses else ""
        note(f"{count} frames sent{slow}")


def _frames(sweep: Sweep, kind: Kind | None) -> tuple[Frames, ImageGrid, bool]:
    """Frames to send, their grid, and whether their vectors are columns."""
    from speckle3d.core.sweep import BModeSettings
    from speckle3d.study.images import grey_images

    is_grey = isinstance(sweep.signal, BModeSettings)
    if kind == "rf" and is_grey:
        raise InvalidInputError(f"--as rf: expected echoes, got {sweep.name}, which holds B-mode")
    if is_grey or kind == "bmode":
        keep_levels = is_grey and sweep.frames.dtype == "uint8"
        images = grey_images(sweep, levels="stored" if keep_levels else "log")
        return images, images.grid, True
    if sweep.grid.fan is not None:
        raise InvalidInputError(f"{sweep.name}: expected parallel vectors to send, got a fan's: --as bmode")
    return sweep.frames, sweep.grid, False
