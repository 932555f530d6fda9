"""The command as a process of its own or in this one, and the options of a small simulation."""

import contextlib
import io
import socket
import sys

RF = (
    "--sampling-rate-hz", 2e8 / 3, "--vector-pitch-mm", 0.3, "--speed-of-sound-m-s", 1540,
    "--centre-frequency-hz", 7.5e6, "--bandwidth-hz", 5e6, 10e6,
)  # fmt: skip
"""What nobody sends of the shipped sweep."""
SMALL = ("--vectors", "26", "--samples", "1800", "--seed", "5")


def command(*arguments):
    return [sys.executable, "-m", "speckle3d.cli", *map(str, arguments)]


def run_command(*arguments):
    """Run it in this process; it must succeed. Returns what it printed on stdout."""
    from speckle3d import cli

    output, before = io.StringIO(), sys.argv
    sys.argv = ["speckle3d", *map(str, arguments)]
    try:
        with contextlib.redirect_stdout(output):
            cli.main()
    except SystemExit as leave:
        if leave.code:
            raise RuntimeError(f"exit code {leave.code}: {' '.join(sys.argv)}") from None
    finally:
        sys.argv = before
    return output.getvalue()


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def read_until(process, words):
    """The first line of its stderr that has these words."""
    lines = []
    for line in process.stderr:
        lines.append(line)
        if words in line:
            return line.strip()
    raise AssertionError("".join(lines))
