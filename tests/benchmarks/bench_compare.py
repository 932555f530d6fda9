"""What worker processes gain a study: two against one, and two of which one is killed.

Run: ``python tests/benchmarks/bench_compare.py [SWEEPS] [FRAMES]`` (16 and 150; minutes; sweeps are cached);
``... --long [REPEATS]`` (10) for one long sweep in blocks: full frames, sixty repeated, which at every
repetition have nothing in common with those before, so that the sweep seems to go on.

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

from speckle3d.config import Config
from speckle3d.io.load import load_sweep
from speckle3d.io.sweep_writer import SweepWriter
from speckle3d.simulation.presets import SimulationSettings
from speckle3d.study.compare import compare_sweeps
from speckle3d.study.schedulers import OnCluster, local_cluster

CURVES = Path(__file__).resolve().parents[2] / "data" / "curves.h5"


BLOCKS = 4
"""Of the long sweep: two workers then have the same to do."""
WAYS = (("one worker", 1, False), ("two", 2, False), ("two, one killed", 2, True))


def timed(paths, warm, config, folder, workers, kill):
    """Seconds of a study, and how many of its sweeps are done."""
    with local_cluster(workers) as client:
        # Kernels are loaded once per process, which is no part of a long study.
        for number, address in enumerate(client.nthreads()):
            client.submit(
                compare_sweeps, [warm], folder / f"warm-{number}", curves=CURVES, workers=address
            ).result()
        began = time.perf_counter()
        if kill:
            victim = next(iter(client.run(os.getpid).values()))
            threading.Thread(target=kill_within, args=(folder / "study", len(paths), victim)).start()
        study = compare_sweeps(
            paths, folder / "study", curves=CURVES, config=config, scheduler=OnCluster(client)
        )
        return time.perf_counter() - began, sum(each.status == "done" for each in study.outcomes)


def kill_within(folder, sweeps, pid):
    """Kill a worker once a third of the sweeps are finished, or a block of the long one."""
    wanted = ("sweeps/*/job.json", sweeps // 3) if sweeps > 1 else ("blocks/*/*.npz", 1)
    while len(list(folder.glob(wanted[0]))) < max(1, wanted[1]):
        time.sleep(0.02)
    os.kill(pid, signal.SIGKILL)


def joined(paths, path):
    """One sweep of all frames: long, and no more to simulate."""
    sweeps = [load_sweep(each) for each in paths]
    with SweepWriter(path, sweeps[0].grid, sweeps[0].signal) as writer:
        for number, (sweep, index) in enumerate((s, i) for s in sweeps for i in range(len(s))):
            writer.append(sweep.frames[index], 0.04 * number)
    return number + 1


def long_study(repeats=10, folder=None):
    """One sweep of 127 x 3818 samples a frame, as long as asked for, in blocks."""
    source = simulated(SimulationSettings(preset="phantom", seed=2001, length_mm=7.5, frames=60))
    path = folder / "long.h5"
    count = joined([source] * repeats, path)
    sys.stdout.write(f"one sweep of {count} frames, {BLOCKS} blocks\n")
    return [path], source, Config.model_validate({"trajectory": {"block_frames": -(-count // BLOCKS)}})


def short_study(sweeps=16, frames=150):
    """Many small sweeps."""
    paths = [
        simulated(
            SimulationSettings(
                preset="tissue", vectors=26, samples=1000, seed=300 + i, length_mm=frames / 8, frames=frames
            )
        )
        for i in range(sweeps)
    ]
    return paths, paths[0], None


def main(long, *counts):
    seconds = {}
    with tempfile.TemporaryDirectory() as made:
        inputs = Path(made)
        paths, warm, config = long_study(*counts, folder=inputs) if long else short_study(*counts)
        for name, workers, kill in WAYS:
            folder = inputs / name.replace(" ", "-")
            seconds[name], done = timed(paths, warm, config, folder, workers, kill)
            shutil.rmtree(folder)
            ratio = seconds[name] / seconds["one worker"]
            sys.stdout.write(
                f"{name:16s} {seconds[name]:7.1f} s  ratio {ratio:.2f}  {done} of {len(paths)} done  "
                f"load {os.getloadavg()[0]:.1f}\n"
            )


if __name__ == "__main__":
    main("--long" in sys.argv, *(int(each) for each in sys.argv[1:] if each != "--long"))
