"""Orientation on BROAD trials beside VQF's: total RMS error, degrees (without a constant heading).

Run: ``python tests/benchmarks/bench_fusion.py FOLDER [--coverage]``, the folder that of the trials' .mat
files. On-line methods stand beside on-line, off-line beside off-line; a star marks where ours is more than
15 % worse than VQF. Last comes the speed. With `--coverage`, how often errors are within one claimed sigma.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

# The packages first: `tests/xsens` is not the one to import.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from broad import OFFLINE, ONLINE, coverage, errors_deg, estimate, read_trial, trials_in

METHODS = ONLINE + OFFLINE
WORSE = 1.15
GROUPS = {
    "undisturbed": ("_undisturbed_",),
    "disturbed": ("_disturbed_",),
    "slow": ("_slow_",),
    "fast": ("_fast_",),
    "tapped or shaken": ("_tapping_", "_vibration_"),
    "beside magnets or iron": ("_magnet_", "_office_", "_mixed"),
    "all": ("",),
}
"""What the names of a group's trials have in them."""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--coverage", action="store_true")
    options = parser.parse_args()
    if options.coverage:
        claims(options.folder)
    else:
        table(options.folder)
        speeds(options.folder)


def table(folder):
    """Every trial, first as BROAD counts, then without a constant heading, and means."""
    print(f"{'RMS, degrees (without constant heading)':42}" + "".join(f"{m:^16}" for m in METHODS))
    cells = {}
    for name in trials_in(folder):
        log, true, moving = read_trial(folder, name)
        found = [estimate(log, method).wxyz for method in METHODS]
        cells[name] = np.array(
            [[errors_deg(f, true, moving, steady)[0] for steady in (False, True)] for f in found]
        )
        print(f"{name:42}{row(cells[name])}", flush=True)
    for label, marks in GROUPS.items():
        part = [cell for name, cell in cells.items() if any(mark in name for mark in marks)]
        if part:
            print(f"{f'mean of {len(part)} {label}':42}{row(np.mean(part, axis=0))}")


def row(cells):
    """Cells of VQF on-line, filter, VQF off-line, smoother."""
    text = ""
    for number, (both, peer) in enumerate(zip(cells, cells[[0, 0, 2, 2]], strict=True)):
        text += f"{both[0]:8.2f} ({both[1]:.2f})" + (
            " *"[bool((both > WORSE * peer).any())] if number % 2 else " "
        )
    return text


def speeds(folder, runs=5):
    """Samples per second of processor time: median of runs in turn."""
    log, _, _ = read_trial(folder, trials_in(folder)[0])
    took = np.median([[timed(log, method) for method in METHODS] for _ in range(runs + 1)][1:], axis=0)
    for method, seconds in zip(METHODS, took, strict=True):
        print(f"{method:14}{len(log) / seconds:12,.0f} samples/s")
    for k in (0, 2):
        print(f"{METHODS[k]} is {took[k + 1] / took[k]:.1f} times as fast as {METHODS[k + 1]}")


def timed(log, method):
    begin = time.thread_time()
    estimate(log, method)
    return time.thread_time() - begin


def claims(folder):
    """Coverage of heading, as BROAD counts it and without a constant, and of inclination."""
    print("share of errors within one claimed sigma, and RMS error / RMS claimed sigma")
    for method in (ONLINE[1], OFFLINE[1]):
        print(f"{method:34}{'heading':>14}{'less constant':>16}{'inclination':>14}")
        found = []
        for name in trials_in(folder):
            log, true, moving = read_trial(folder, name)
            guess = estimate(log, method)
            one, other = (coverage(guess, true, moving, steady) for steady in (False, True))
            found.append([*one[:2], *other[:2], *other[2:]])
            print(f"{name[:34]:34}{shares(found[-1])}", flush=True)
        print(f"{'mean':34}{shares(np.mean(found, axis=0))}")
        worst = np.max(found, axis=0)[1::2]
        print(f"{'worst error over sigma':34}" + "".join(f"{w:14.2f}" for w in worst))


def shares(cells):
    return "".join(f"{100 * s:8.0f} %{r:5.2f}" for s, r in zip(cells[::2], cells[1::2], strict=True))


if __name__ == "__main__":
    main()
