"""Calibrations against truth: whether claimed errors are true, and whether what cannot be told is refused.

Run: ``python tests/benchmarks/bench_calibration_errors.py [KIND ...] [--share 0.1] [--first-seed N]``.

Every kind of calibration has its module in `calibration_errors`, with the set-ups, the simulation and the
truth. Seeds and set-ups are not those of development. Ends with status 1 where a
target is missed, but for ``--quick``.
"""

import os
import sys
import time
from importlib import import_module
from pathlib import Path

import bench

os.environ.setdefault("NUMBA_NUM_THREADS", "1")

FOLDER = Path(__file__).resolve().parent
KINDS = sorted(path.stem for path in (FOLDER / "calibration_errors").glob("[!_]*.py") if path.stem != "rows")
FIRST_SEED = 900_001


def main():
    parser = bench.parser_of(__doc__)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"any of: {', '.join(KINDS)}; or all")
    parser.add_argument("--share", type=float, default=1.0, help="of the trials")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    options = bench.parse_options(parser, share=0.02, kinds=["clock", "motions", "plane"])
    if unknown := sorted(set(options.kinds) - set(KINDS)):
        parser.error(f"expected kinds among {', '.join(KINDS)}, got {', '.join(unknown)}")
    misses = 0
    for kind in options.kinds or KINDS:
        start_s = time.perf_counter()
        rows = import_module(f"calibration_errors.{kind}").measure(options.share, options.first_seed)
        print(f"{kind} ({time.perf_counter() - start_s:.0f} s)", flush=True)
        for row in rows:
            print(f"  {'' if row.is_on_target else 'MISSED '}{row.case}: {row.figures} (target {row.target})")
        misses += sum(not row.is_on_target for row in rows)
    # The few trials of a quick run miss some by chance.
    sys.exit(1 if misses and not options.quick else 0)


if __name__ == "__main__":
    main()
