"""Speed and memory of what makes a user wait, beside peers or limits in the same process, as one table.

Run: ``python tests/benchmarks/bench_speed.py [--runs 7] [--only WHAT ...]`` on a quiet machine. Needs the
extra ``bench``. Frames are of 127 vectors by 3818 samples; sweeps are simulated once (ten minutes) and
kept. A ``!`` marks a target that is missed; peers are given in the unit of the row.
"""

import platform
from functools import cache
from importlib import import_module

import bench
from bench_accuracy import curves_of
from cache import DEFAULT, sweep_file, to_and_fro
from speed import commands
from speed.rows import print_table

from speckle3d.core.threads import cores
from speckle3d.io.family.curves import write_curves
from speckle3d.simulation.settings import SimulationSettings

SWEEP = SimulationSettings(preset="phantom", seed=2001, length_mm=7.5, frames=60)


def main():
    curves_file = DEFAULT / "curves-of-bench.h5"

    curves = cache(lambda: curves_of(DEFAULT))

    def long(frames):
        return to_and_fro(sweep_file(SWEEP), frames)

    inputs = {
        "tracking": lambda: ([sweep_file(SWEEP), long(commands.FRAMES[0])], curves()),
        "patches": lambda: (sweep_file(SWEEP),),
    }
    parts = ("tracking", "patches", "sensors", "commands", "voxels", "memory")
    parser = bench.parser_of(__doc__)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--only", nargs="*", choices=parts, default=parts)
    options = bench.parse_options(parser, runs=1, only=["commands"])
    print(f"{platform.machine()}, {cores()} cores, {platform.system()}", flush=True)
    table = []
    for part in options.only:
        if part == "memory":
            write_curves(curves_file, curves())
            table += commands.memory(map(long, commands.FRAMES), curves_file)
        else:
            table += import_module(f"speed.{part}").rows(*inputs.get(part, tuple)(), options.runs)
    print_table(table)


if __name__ == "__main__":
    main()
