"""What worker processes gain a study: two against one.

Run: ``python tests/benchmarks/bench_compare.py [SWEEPS] [FRAMES]`` (16 and 150; minutes; sweeps are cached).

Starting the processes and loading the kernels is part of each time. A ratio on two cores that are busy with
something else says little: the load is printed beside it.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from cache import simulated

from speckle3d.simulation.presets import SimulationSettings
from speckle3d.study.compare import compare_sweeps
from speckle3d.study.schedulers import Scheduler

CURVES = Path(__file__).resolve().parents[2] / "data" / "curves.h5"


def seconds_by_workers(sweeps=16, frames=150):
    """Seconds that one worker and two take for a study of many small sweeps."""
    small = {"preset": "tissue", "vectors": 26, "samples": 1000, "length_mm": frames / 8, "frames": frames}
    paths = [simulated(SimulationSettings(**small, seed=300 + i)) for i in range(sweeps)]
    seconds = {}
    for workers in (1, 2):
        with tempfile.TemporaryDirectory() as folder:
            began = time.perf_counter()
            study = compare_sweeps(paths, Path(folder), curves=CURVES, scheduler=Scheduler(workers))
            seconds[workers] = time.perf_counter() - began
            assert all(each.status == "done" for each in study.outcomes)
    return seconds


def main(sweeps=16, frames=150):
    seconds = seconds_by_workers(sweeps, frames)
    for workers, spent in seconds.items():
        ratio, load = spent / seconds[1], os.getloadavg()[0]
        sys.stdout.write(f"{workers} workers {spent:7.1f} s  ratio {ratio:.2f}  load {load:.1f}\n")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
