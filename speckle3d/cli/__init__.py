"""The command line. Heavy modules are imported inside the commands, so that help and errors come at once."""

from __future__ import annotations

import os
import sys

# Small factorisations lose far more to a team of threads than they gain; set before NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import typer

# Importing a module of commands registers them.
from speckle3d.cli import (  # noqa: F401
    calibrate_clock,
    calibrate_curves,
    calibrate_images,
    calibrate_phantoms,
    compare,
    files,
    imu,
    imu_accuracy,
    reconstruction,
    trajectory,
)
from speckle3d.cli.common import app, note
from speckle3d.core.errors import Speckle3DError

__all__ = ["app", "main"]

_STOPPED = 130
"""Exit code after Ctrl-C, as shells have it."""


def main() -> None:
    """Run the command line: a wrong input is one line on stderr and exit code 2."""
    try:
        code = app(standalone_mode=False)
    except Speckle3DError as error:
        _fail(str(error))
    except (KeyboardInterrupt, typer.Abort):
        _fail("stopped", _STOPPED)
    except typer.Exit as leave:
        sys.exit(leave.exit_code)
    except Exception as error:
        # Typer's own usage errors carry an exit code; anything else is a bug and shows its traceback.
        if not hasattr(error, "format_message"):
            raise
        # Called with no command at all, it has shown its help and has nothing to say.
        if not error.format_message().strip():
            sys.exit(2)
        _fail(error.format_message())
    # Typer turns Ctrl-C into this exit code without a word.
    if code == _STOPPED:
        _fail("stopped", _STOPPED)
    sys.exit(code if isinstance(code, int) else 0)


def _fail(message: str, code: int = 2) -> None:
    note(f"speckle3d: {' '.join(message.split())}")
    sys.exit(code)
