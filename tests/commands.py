"""The command as a process of its own or in this one, and the options of a small simulation."""

import contextlib
import io
import sys

SMALL = ("--vectors", "26", "--samples", "1800", "--seed", "5")


def command(*arguments):
    return [sys.executable, "-m", "speckle3d.cli", *map(str, arguments)]


def run_command(*arguments):
    """Run it in this process; it must succeed. Returns what it printed on stdout."""
    from speckle3d import cli

    told, before = io.StringIO(), sys.argv
    sys.argv = ["speckle3d", *map(str, arguments)]
    try:
        with contextlib.redirect_stdout(told):
            cli.main()
    except SystemExit as leave:
        if leave.code:
            raise RuntimeError(f"exit code {leave.code}: {' '.join(sys.argv)}") from None
    finally:
        sys.argv = before
    return told.getvalue()
