"""Orientation on BROAD trials beside VQF's: total RMS error, degrees (without a constant heading).

Run: ``python tests/benchmarks/bench_fusion.py [FOLDER]``, the folder that of the trials' .mat files;
without one, of a simulated sensor with iron on it. On-line methods stand beside on-line, off-line beside
off-line. Last comes how often errors are within one claimed sigma.
"""

from pathlib import Path

import bench
import numpy as np
from broad import OFFLINE, ONLINE, coverage, errors_deg, estimate, read_trial, trials_in
from field_scenes import scene, simulate_motion

METHODS = ONLINE + OFFLINE
GROUPS = {"undisturbed": "_undisturbed_", "disturbed": "_disturbed_", "all": ""}
"""What the names of a group's trials have in them."""


def trials(folder):
    """Name, log, true orientation and where the sensor moved, of every trial."""
    if folder is None:
        rng = np.random.default_rng(20)
        yield "attached", *scene(simulate_motion(rng, 20.0), "attached", 5.0, rng)
    else:
        for name in trials_in(folder):
            yield name, *read_trial(folder, name)


def row(cells):
    return "".join(f"{errors[0]:8.2f} ({errors[1]:.2f})  " for errors in cells)


def main():
    parser = bench.parser_of(__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    options = bench.parse_options(parser, folder=None)
    print(f"{'RMS, degrees (without constant heading)':42}" + "".join(f"{m:^16}" for m in METHODS))
    cells, shares = {}, []
    for name, log, true, moving in trials(options.folder):
        estimates = [estimate(log, method) for method in METHODS]
        cells[name] = np.array(
            [[errors_deg(f.wxyz, true, moving, steady)[0] for steady in (False, True)] for f in estimates]
        )
        shares.append([coverage(f, true, moving) for f in estimates[1::2]])
        print(f"{name:42}{row(cells[name])}", flush=True)
    for label, mark in GROUPS.items():
        part = [cell for name, cell in cells.items() if mark in name]
        if part:
            print(f"{f'mean of {len(part)} {label}':42}{row(np.mean(part, axis=0))}")
    print(
        "share of errors within one claimed sigma, and the worst trial's RMS error over its RMS claimed sigma"
    )
    shares = np.array(shares)
    for method, mean, worst in zip(METHODS[1::2], shares.mean(axis=0), shares.max(axis=0), strict=True):
        print(f"  {method}: heading {mean[0]:.0%}, {worst[1]:.2f}; inclination {mean[2]:.0%}, {worst[3]:.2f}")


if __name__ == "__main__":
    main()
