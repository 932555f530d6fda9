"""Peak resident memory of ``speckle3d reconstruct`` by length of the sweep."""

import os
import subprocess
import sys
import tempfile
import time

from speed.rows import Row

FRAMES = (300, 1200, 2000)
TARGET_GB = 0.5


def rows(paths, curves):
    """One row for each sweep."""
    return [one(path, curves) for path in paths]


def one(path, curves):
    """Run the command and ask the system for its peak."""
    with tempfile.TemporaryDirectory() as folder:
        modes = ["--drift", "orientation", "--drift", "pose"]
        arguments = ["reconstruct", str(path), "--curves", str(curves), "-o", folder, *modes]
        began = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "speckle3d.cli", *arguments], stdout=subprocess.DEVNULL
        )
        _, status, usage = os.wait4(process.pid, 0)
        spent = time.perf_counter() - began
    assert status == 0, f"{path}: status {status}"
    frames = path.stem.rpartition("-")[2]
    return Row(
        f"reconstruct, {frames} frames, {path.stat().st_size / 1e9:.2f} GB, in {spent:.1f} s: peak memory",
        usage.ru_maxrss / 2**20,
        "GB",
        target=TARGET_GB,
        falling=True,
    )
