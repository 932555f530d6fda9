"""Commands from start to end, beside what Python needs to start and to load the libraries they stand on."""

import os
import statistics
import subprocess
import sys
import tempfile
import time

import bench

from speed.rows import Row

HELP_S, RECONSTRUCT_S, MEMORY_GB = 0.3, 3.0, 0.5
FRAMES = (300, 1200, 2000)
"""Of the sweeps whose memory is measured."""
LIBRARIES = "import numpy, scipy.optimize, scipy.spatial.transform, numba, h5py, matplotlib.figure"


def rows(runs):
    """Help, and the sweep that comes with the project reconstructed in two modes."""
    bare = seconds(["-c", "import typer, rich.console"], runs)
    help_s = seconds(["-m", "speckle3d.cli", "--help"], runs)
    libraries = seconds(["-c", LIBRARIES], runs)
    whole = statistics.median([reconstruct(bench.DATA / "phantom.h5")[0] for _ in range(runs + 1)][1:])
    beside = {"falling": True, "unit": "s"}
    return [
        Row("speckle3d --help", help_s, peer="importing typer and rich", peer_value=bare,
            target=HELP_S, **beside),
        Row("speckle3d reconstruct data/phantom.h5, two modes", whole, peer="importing its libraries",
            peer_value=libraries, target=RECONSTRUCT_S, **beside),
    ]  # fmt: skip


def memory(paths, curves):
    """Peak resident memory of a reconstruction by length of the sweep."""
    for path in paths:
        duration_s, peak_gb = reconstruct(path, "--curves", curves)
        size = f"{path.stem.rpartition('-')[2]} frames, {path.stat().st_size / 1e9:.2f} GB"
        label = f"reconstruct, {size}, in {duration_s:.1f} s: peak memory"
        yield Row(label, peak_gb, "GB", target=MEMORY_GB, falling=True)


def seconds(arguments, runs):
    """Median of several runs, after one in which kernels are compiled and files are read from the disk."""
    return statistics.median([run_python(arguments)[0] for _ in range(runs + 1)][1:])


def reconstruct(path, *options):
    with tempfile.TemporaryDirectory() as out:
        modes = ["--drift", "orientation", "--drift", "pose"]
        return run_python(["-m", "speckle3d.cli", "reconstruct", path, *options, "-o", out, *modes])


def run_python(arguments):
    """Seconds and the peak memory, GB, of Python with some arguments."""
    start_s = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, *map(str, arguments)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(process.pid, 0)
    assert status == 0, f"{arguments}: status {status}"
    return time.perf_counter() - start_s, usage.ru_maxrss / 2**20
