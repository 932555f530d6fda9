"""What worker processes gain a study: two against one, and two of which one is killed.

Run: ``python tests/benchmarks/bench_compare.py [SWEEPS] [FRAMES]`` (16 and 60; minutes; sweeps are cached).

Each study runs on workers that are there already and have each done one sweep, as on an existing cluster. A
ratio on two cores that are busy with something else says little: the load is printed beside it.
"""

import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from cache import simulated

from speckle3d.simulation.presets import SimulationSettings
from speckle3d.study.compare import compare_sweeps
from speckle3d.study.schedulers import OnCluster, local_cluster

CURVES = Path(__file__).resolve().parents[2] / "data" / "curves.h5"


def timed(paths, folder, workers, kill=False):
    """Seconds of a study, and how many of its sweeps are done."""
    with local_cluster(workers) as client:
        # Kernels are loaded once per process, which is no part of a long study.
        for number, address in enumerate(client.nthreads()):
            client.submit(
                compare_sweeps, paths[:1], folder / f"warm-{number}", curves=CURVES, workers=address
            ).result()
        began = time.perf_counter()
        if kill:
            victim = next(iter(client.run(os.getpid).values()))
            threading.Thread(
                target=kill_within, args=(folder / "study" / "sweeps", len(paths), victim)
            ).start()
        study = compare_sweeps(paths, folder / "study", curves=CURVES, scheduler=OnCluster(client))
        return time.perf_counter() - began, sum(each.status == "done" for each in study.outcomes)


def kill_within(folder, sweeps, pid):
    """Kill a worker once a third of the sweeps are finished."""
    while len(list(folder.glob("*/job.json"))) < max(1, sweeps // 3):
        time.sleep(0.02)
    os.kill(pid, signal.SIGKILL)


def main(sweeps=16, frames=60):
    paths = [
        simulated(
            SimulationSettings(
                preset="tissue", vectors=26, samples=1000, seed=300 + i, length_mm=frames / 8, frames=frames
            )
        )
        for i in range(sweeps)
    ]
    seconds = {}
    for name, workers, kill in (("one worker", 1, False), ("two", 2, False), ("two, one killed", 2, True)):
        folder = Path(tempfile.mkdtemp())
        seconds[name], done = timed(paths, folder, workers, kill)
        shutil.rmtree(folder)
        ratio = seconds[name] / seconds["one worker"]
        sys.stdout.write(
            f"{name:16s} {seconds[name]:7.1f} s  ratio {ratio:.2f}  {done} of {sweeps} done  "
            f"load {os.getloadavg()[0]:.1f}\n"
        )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
