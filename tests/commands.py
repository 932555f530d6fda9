"""The command as a process of its own, and the options of a small simulation."""

import sys

SMALL = ("--vectors", "26", "--samples", "1800", "--seed", "5")


def command(*arguments):
    return [sys.executable, "-m", "speckle3d.cli", *map(str, arguments)]
