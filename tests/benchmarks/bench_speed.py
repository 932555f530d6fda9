"""Speed and memory of what makes a user wait, beside peers or limits in the same process, as one table.

Run: ``python tests/benchmarks/bench_speed.py [--runs 7] [--only WHAT ...]`` on a quiet machine. Needs the
extra ``bench``. Frames are of 127 vectors by 3818 samples; sweeps are simulated once (ten minutes) and kept.
A ``!`` marks a target that is missed; peers are given in the unit of the row.
"""

import argparse
import os
import platform
import sys
from functools import cache
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench_accuracy import curves_of
from cache import DEFAULT, simulated, to_and_fro
from options import parsed
from speed import commands, memory, patches, sensors, simulation, tracking
from speed.rows import print_table

from speckle3d.core.threads import cores
from speckle3d.io.curves import write_curves
from speckle3d.simulation.settings import SimulationSettings

PARTS = ("tracking", "patches", "sensors", "simulation", "commands", "memory")
SWEEP = SimulationSettings(preset="phantom", seed=2001, length_mm=7.5, frames=60)


def machine():
    """Kind of processor, and how many of its cores are used."""
    names = [line.partition(":")[2].strip() for line in _lines("/proc/cpuinfo") if "model name" in line]
    return f"{names[0] if names else platform.processor()}, {cores()} cores, {platform.system()}"


def _lines(path):
    return Path(path).read_text().splitlines() if Path(path).is_file() else []


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--cache", type=Path, default=DEFAULT)
    parser.add_argument("--only", nargs="*", choices=PARTS, default=[], help=f"parts: {', '.join(PARTS)}")
    options = parsed(parser, runs=1, only=["commands"])
    folder, runs = options.cache, options.runs
    curves_file = folder / "curves-of-bench.h5"

    @cache
    def curves():
        made = curves_of(folder)
        write_curves(curves_file, made)
        return made

    @cache
    def long():
        return [to_and_fro(simulated(SWEEP, folder), frames, folder) for frames in memory.FRAMES]

    ways = {
        "tracking": lambda: tracking.rows([simulated(SWEEP, folder), long()[0]], curves(), runs),
        "patches": lambda: patches.rows(simulated(SWEEP, folder), runs),
        "sensors": lambda: sensors.rows(runs),
        "simulation": lambda: simulation.rows(runs),
        "commands": lambda: commands.rows(runs),
        "memory": lambda: curves() and memory.rows(long(), curves_file),
    }
    print(machine(), flush=True)
    print_table([row for part in options.only or PARTS for row in ways[part]()])


if __name__ == "__main__":
    main()
