"""Commands from start to end, beside what Python needs to start and to load the libraries they stand on."""

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from speed.rows import Row

SHIPPED = Path(__file__).resolve().parents[3] / "data" / "phantom.h5"
HELP_S, RECONSTRUCT_S = 0.3, 3.0
LIBRARIES = "import numpy, scipy.optimize, scipy.spatial.transform, numba, h5py, matplotlib.figure"
COMMAND = [sys.executable, "-m", "speckle3d.cli"]


def rows(runs):
    """Help, and the sweep that comes with the project reconstructed in two modes."""
    bare = seconds([sys.executable, "-c", "import typer, rich.console"], runs)
    helped = seconds([*COMMAND, "--help"], runs)
    libraries = seconds([sys.executable, "-c", LIBRARIES], runs)
    with tempfile.TemporaryDirectory() as folder:
        modes = ["--drift", "orientation", "--drift", "pose"]
        whole = seconds([*COMMAND, "reconstruct", str(SHIPPED), "-o", folder, *modes], runs)
    return [
        Row("speckle3d --help", helped, "s", "importing typer and rich", bare, HELP_S, falling=True),
        Row(
            "speckle3d reconstruct data/phantom.h5, two modes",
            whole,
            "s",
            "importing its libraries",
            libraries,
            RECONSTRUCT_S,
            falling=True,
        ),
    ]


def seconds(command, runs):
    """Median of several runs, after one in which kernels are compiled and files are read from the disk."""
    spent = []
    for _ in range(runs + 1):
        began = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        spent.append(time.perf_counter() - began)
    return statistics.median(spent[1:])
