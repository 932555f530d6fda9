"""The command as a process of its own, and the options of a small simulation."""

import subprocess
import sys

SMALL = ("--vectors", "26", "--samples", "1800", "--seed", "5")


def command(*arguments):
    return [sys.executable, "-m", "speckle3d.cli", *map(str, arguments)]


def run_command(*arguments):
    """Run it in a process of its own; it must succeed."""
    done = subprocess.run(command(*arguments), capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
