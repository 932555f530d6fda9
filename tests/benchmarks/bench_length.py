"""Whether lengths hold when the curves do not: RF sweeps through the command, cheaper cases for statistics.

``python tests/benchmarks/bench_length.py [PART ...] [--seeds N] [--first-seed N]``; parts are sweeps,
crossing and fused. RF sweeps are simulated once (an hour and a half on two cores) and kept.
"""

import argparse
import sys
import time
from importlib import import_module
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from cache import DEFAULT
from length.rows import show
from length.scenes import FIRST_SEED

STATISTICS = ("crossing", "fused")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", nargs="*", choices=("sweeps", *STATISTICS), help="by default all")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--seeds", type=int, default=6, help="RF sweeps of each case")
    parser.add_argument("--share", type=float, default=1.0, help="of the cheaper cases")
    parser.add_argument("--case", default="", help="only RF cases whose name holds this")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=DEFAULT)
    options = parser.parse_args()
    began = time.perf_counter()
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    for part in options.part or ("sweeps", *STATISTICS):
        print(f"\n{part}:")
        module = import_module(f"length.{part}")
        if part == "sweeps":
            module.measure(seeds, options.cache, options.workers, options.case)
        else:
            show(module.measure(options.share, options.first_seed))
    print(f"\n{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
