"""The command line. Heavy modules are imported inside the commands, so that help and errors come at once."""

import io
import os
import signal
import sys
import warnings

# Small factorisations lose far more to a team of threads than they gain; set before NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from speckle3d.cli.commands import Table, group
from speckle3d.cli.common import emit, note
from speckle3d.cli.signals import stoppable
from speckle3d.core.errors import NoSpaceError, Speckle3DError

_CALIBRATE: Table = {
    "curves": "speckle3d.cli.calibrate.curves:curves",
    "plane": "speckle3d.cli.calibrate.phantoms:plane",
    "orientation": "speckle3d.cli.calibrate.phantoms:orientation",
    "wires": "speckle3d.cli.calibrate.phantoms:wires",
    "images": "speckle3d.cli.calibrate.images:images",
    "clock": "speckle3d.cli.calibrate.images:clock",
    "repeatability": "speckle3d.cli.calibrate.phantoms:repeatability",
}
_TRAJECTORY: Table = {"export": "speckle3d.cli.trajectory:export", "score": "speckle3d.cli.trajectory:score"}
_IMU: Table = {
    "info": "speckle3d.cli.sensors.imu:info",
    "convert": "speckle3d.cli.sensors.imu:convert",
    "orient": "speckle3d.cli.sensors.imu:orient",
    "accuracy": "speckle3d.cli.sensors.imu:accuracy",
    "record": "speckle3d.cli.sensors.imu:record",
}
_COMMANDS: Table = {
    "reconstruct": "speckle3d.cli.reconstruction:reconstruct",
    "calibrate": (
        "Calibrate what a reconstruction needs: curves of a probe, mountings of sensors.\n\n"
        "Example: speckle3d calibrate plane bath.h5 -o tracker.h5 --reflector bar",
        _CALIBRATE,
    ),
    "volume": "speckle3d.cli.look.volumes:volume",
    "view": "speckle3d.cli.look.view:view",
    "reslice": "speckle3d.cli.look.volumes:reslice",
    "measure": "speckle3d.cli.look.measures:measure",
    "surface": "speckle3d.cli.look.measures:surface",
    "scene": "speckle3d.cli.look.volumes:scene",
    "info": "speckle3d.cli.files:info",
    "convert": "speckle3d.cli.files:convert",
    "trajectory": (
        "Trajectories as TUM text, and scores of them.\n\n"
        "Example: speckle3d trajectory export out/reconstruction.h5 -o poses.tum --mode pose",
        _TRAJECTORY,
    ),
    "compare": "speckle3d.cli.reconstruction:compare",
    "imu": (
        "The orientation sensor: logs, live data, orientation.\n\nExample: speckle3d imu info log.mtb",
        _IMU,
    ),
    "live": "speckle3d.cli.stream:live",
    "play": "speckle3d.cli.stream:play",
    "simulate": "speckle3d.cli.files:simulate",
    "config": "speckle3d.cli.files:config",
}
"""In the order of work: what most sessions need first."""

_STOPPED = 128 + signal.SIGINT
"""Exit code after Ctrl-C, as shells have it."""


app = group(
    "Freehand 2-D ultrasound sweeps to measured 3-D; `speckle3d --version` prints the version.", _COMMANDS
)


def main() -> None:
    """Run the command line.

    A wrong input is one line on stderr and exit code 2, a full disk one and exit code 1. Signals that ask for
    the end stop the command as Ctrl-C does, with exit code 128 and their number.
    """
    sys.stdout, sys.stderr = (stream or io.StringIO() for stream in (sys.stdout, sys.stderr))  # if closed
    for stream in (sys.stdout, sys.stderr):  # a terminal of another encoding shows what it can
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    with stoppable() as heard, warnings.catch_warnings():
        warnings.showwarning = _tell
        _run(heard)


def _tell(message: Warning | str, *_: object, **__: object) -> None:
    note(f"speckle3d: {' '.join(str(message).split())}")


def _run(heard: list[int]) -> None:
    if sys.argv[1:] == ["--version"]:
        from speckle3d import __version__

        emit(f"speckle3d {__version__}")
        return
    try:
        code = app(standalone_mode=False, prog_name="speckle3d")
    except Speckle3DError as error:
        _fail(str(error), 1 if isinstance(error, NoSpaceError) else 2)
    except (KeyboardInterrupt, Exception) as error:
        # A signal that is dropped within a compilation makes it fail in its own way. Typer's own usage errors
        # have a message, which is the help of a group without a command; anything else is a bug.
        if heard or isinstance(error, KeyboardInterrupt):
            code = _STOPPED
        elif not hasattr(error, "format_message"):
            raise
        elif type(error).__name__ == "NoArgsIsHelpError":
            emit(error.format_message())
            sys.exit(2)
        else:
            _fail(error.format_message().replace("Value error, ", ""))
    # Typer turns Ctrl-C into this exit code without a word; a recording ends with it and is whole.
    if code == _STOPPED or (heard and heard[0] != signal.SIGINT):
        _fail("stopped", 128 + heard[0] if heard else _STOPPED)
    sys.exit(code if isinstance(code, int) else 0)


def _fail(message: str, code: int = 2) -> None:
    _tell(message)
    sys.exit(code)
