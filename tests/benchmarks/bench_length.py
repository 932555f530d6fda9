"""Whether lengths hold when the curves do not: RF sweeps through the command, cheaper cases for statistics.

``python tests/benchmarks/bench_length.py [sweeps] [crossing] [--seeds N] [--first-seed N]``. RF sweeps are
simulated once (an hour and a half on two cores) and kept.
"""

import bench
from cache import DEFAULT
from length import crossing, sweeps

FIRST_SEED = 970_001
"""Judged seeds count from here; development used 1 to 99."""


def main():
    parser = bench.parser_of(__doc__)
    parser.add_argument("part", nargs="*", help="sweeps, crossing; by default both")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--seeds", type=int, default=6, help="RF sweeps of each case")
    parser.add_argument("--share", type=float, default=1.0, help="of the cheaper cases")
    parser.add_argument("--workers", type=int, default=2)
    options = bench.parse_options(parser, part=["crossing"], share=0.01)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    parts = {
        "sweeps": lambda: sweeps.measure(seeds, DEFAULT, options.workers),
        "crossing": lambda: crossing.measure(options.share, options.first_seed),
    }
    for part in options.part or parts:
        for name, text in parts[part]():
            print(f"{name}\n    {text}", flush=True)
            if options.quick:
                return


if __name__ == "__main__":
    main()
