"""Orientation on BROAD trials beside VQF's: total RMS error, degrees (without a constant heading).

python tests/benchmarks/bench_fusion.py FOLDER [OPTION]...   (with the trials' .mat files; all are used)

Without options: every trial, the means, and the speed. On-line methods stand beside on-line, off-line beside
off-line; a star marks where ours is more than 15 % worse than VQF.

--inclination        the errors of inclination instead
--coverage           how often errors are within one claimed sigma
--scenes tune|judge  the trials' motion in invented magnetic fields, or with a worse gyroscope
--leave-one-out      engine and settings as chosen on all trials but one, scored on that one
"""

import subprocess
import sys
import time
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np

# The packages first: `tests/xsens` is not the one to import.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from broad import (
    OFFLINE,
    ONLINE,
    counting,
    coverage,
    errors_deg,
    estimate,
    read_trial,
    rms_deg,
    trials_in,
)
from field_scenes import scenes
from vqf import VQF

from xsens.fusion.online import OnlineFilter
from xsens.fusion.settings import FusionSettings, Method

METHODS = ONLINE + OFFLINE
WORSE = 1.15

SINGLY = 5000
"""Samples that are given one by one."""

GRID = {
    "field_place": (0.5, 1.0, 2.0),
    "moving_bias_rad_s": (0.5, 1.0, 2.0),
}
"""Candidates of --leave-one-out: the settings with each of these fields times each factor."""

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
    if len(sys.argv) < 2 or "--help" in sys.argv:
        sys.exit(__doc__ if len(sys.argv) < 2 else print(__doc__))
    folder, options = Path(sys.argv[1]), sys.argv[2:]
    if not trials_in(folder):
        sys.exit(f"expected a folder of .mat files, got {folder}")
    if "--first" in options:
        print(timed(estimate, read_trial(folder, trials_in(folder)[0])[0], options[1]))
    elif "--coverage" in options:
        claims(folder)
    elif "--scenes" in options:
        in_fields(folder, options[options.index("--scenes") + 1])
    elif "--leave-one-out" in options:
        leave_one_out(folder)
    else:
        table(folder, 2 if "--inclination" in options else 0)


@cache
def scores(folder, name, method, settings=None):
    """RMS of total, heading and inclination, first as BROAD counts, then without a constant heading."""
    log, true, moving = read_trial(folder, name)
    found = estimate(log, method, settings).wxyz
    return np.array([errors_deg(found, true, moving, steady) for steady in (False, True)])


# -- every trial


def table(folder, kind):
    names = trials_in(folder)
    print(f"{'RMS, degrees (without constant heading)':42}" + "".join(f"{m:^16}" for m in METHODS))
    cells = {name: np.array([scores(folder, name, m)[:, kind] for m in METHODS]) for name in names}
    for name in names:
        print(f"{name:42}" + row(cells[name]), flush=True)
    for label, marks in GROUPS.items():
        part = [name for name in names if any(mark in name for mark in marks)]
        if part:
            print(f"{f'mean of {len(part)} {label}':42}" + row(np.mean([cells[n] for n in part], axis=0)))
    if not kind:
        speeds(folder)


def row(cells):
    """Cells of VQF on-line, filter, VQF off-line, smoother: (as BROAD counts, without constant heading)."""
    stars = [" ", star(cells[0], cells[1]), " ", star(cells[2], cells[3])]
    both = [f"{a:.2f} ({b:.2f})" for a, b in cells]
    return "".join(f"{text:>15}{mark}" for text, mark in zip(both, stars, strict=True))


def star(theirs, ours):
    return "*" if (np.asarray(ours) > WORSE * np.asarray(theirs)).any() else " "


# -- speed


def speeds(folder, runs=5):
    """Samples per second of processor time: median of runs in turn, the first in a process, one by one."""
    log, _, _ = read_trial(folder, trials_in(folder)[0])
    methods = (*METHODS, Method.vqf_online, Method.vqf)
    took = [[timed(estimate, log, method) for method in methods] for _ in range(runs + 1)][1:]
    pace = dict(zip(methods, len(log) / np.median(took, axis=0), strict=True))
    print(f"{'samples/s':14}{'a log':>12}{'first log':>12}{'one by one':>12}")
    for method in methods:
        again = [sys.executable, __file__, str(folder), "--first", method]
        first = len(log) / float(subprocess.run(again, capture_output=True, check=True, text=True).stdout)
        singly = f"{SINGLY / timed(one_by_one, log, method):12,.0f}" if method in ONLINE else ""
        print(f"{method:14}{pace[method]:12,.0f}{first:12,.0f}{singly}")
    for theirs, ours in (ONLINE, OFFLINE):
        print(f"{theirs} is {pace[theirs] / pace[ours]:.1f} times as fast as {ours}")


def timed(work, *arguments):
    begin = time.thread_time()
    work(*arguments)
    return time.thread_time() - begin


def one_by_one(log, method):
    rows = list(zip(log.gyroscope_rad_s, log.accelerometer_m_s2, log.magnetometer_au, strict=True))[:SINGLY]
    if method == "filter":
        live = OnlineFilter()
        for gyroscope, force, field in rows:
            live.push(1.0 / log.rate_hz, gyroscope, force, field)
    else:
        peer = VQF(1.0 / log.rate_hz)
        for gyroscope, force, field in rows:
            peer.update(gyroscope, force, field)


# -- claimed sigmas


def claims(folder):
    """Coverage of heading, as BROAD counts it and without a constant, and of inclination."""
    print("share of errors within one claimed sigma, and RMS error / RMS claimed sigma")
    print("heading: as BROAD counts it (cameras' north against magnetic north), and without a constant")
    for method in Method:
        print(f"{method:34}{'heading':>14}{'less constant':>16}{'inclination':>14}")
        found = []
        for name in trials_in(folder):
            log, true, moving = read_trial(folder, name)
            guess = estimate(log, method)
            one, other = (coverage(guess, true, moving, steady) for steady in (False, True))
            found.append([*one[:2], *other[:2], *other[2:]])
            print(f"{name[:34]:34}{shares(found[-1])}", flush=True)
        held = np.array(found)
        print(f"{'mean':34}{shares(held.mean(axis=0))}")
        worst = held[:, 1::2].max(axis=0)
        print(f"{'worst error over sigma':34}" + "".join(f"{w:14.2f}" for w in worst))


def shares(cells):
    return "".join(f"{100 * s:8.0f} %{r:5.2f}" for s, r in zip(cells[::2], cells[1::2], strict=True))


# -- invented fields


def in_fields(folder, split):
    """Errors of all methods; of ours, heading's error and claimed sigma, `!` where beyond twice."""
    heads = "".join(f"{m:^16}" for m in METHODS)
    print(f"{f'{split}: RMS, degrees':24}{heads}  heading, sigma of filter | smoother")
    every, wrong = [], 0
    for scene in scenes(folder, split):
        found = [estimate(scene.log, method) for method in METHODS]
        cells = [
            [errors_deg(each.wxyz, scene.true_wxyz, scene.moving, steady)[0] for steady in (False, True)]
            for each in found
        ]
        every.append(cells)
        told = " | ".join(claim(each, scene) for each in (found[1], found[3]))
        wrong += told.count("!")
        print(f"{scene.name:24}{row(np.array(cells))}  {told}", flush=True)
    print(f"{'mean':24}{row(np.mean(every, axis=0))}")
    print(f"{'median':24}{row(np.median(every, axis=0))}")
    ratio = np.exp(np.log(np.array(every)[:, 1::2] / np.array(every)[:, ::2]).mean(axis=0))
    print(f"geometric mean of ours / VQF's: on-line {pair(ratio[0])}, off-line {pair(ratio[1])}")
    print(f"headings off by more than twice their claimed sigma: {wrong} of {2 * len(every)}")


def claim(found, scene):
    counts = counting(scene.true_wxyz, scene.moving)
    error = errors_deg(found.wxyz, scene.true_wxyz, scene.moving)[1]
    sigma = rms_deg(found.sigma_rad[counts, 2])
    return f"{error:6.2f} {sigma:6.2f}{'!' if error > 2.0 * sigma else ' '}"


# -- settings


def candidates(method):
    """Settings by what they change."""
    if method.startswith("VQF"):
        return {method: None}
    default = FusionSettings()
    found = {}
    for factors in product(*GRID.values()):
        chosen = dict(zip(GRID, factors, strict=True))
        changes = {name: factor * getattr(default, name) for name, factor in chosen.items()}
        label = ", ".join(f"{name} x {factor:g}" for name, factor in chosen.items() if factor != 1.0)
        found[f"{method}: {label or 'as it is'}"] = replace(default, **changes)
    return found


def leave_one_out(folder):
    """Of both engines and all candidates, the one with the least mean of both columns on the others."""
    names = trials_in(folder)
    for theirs, ours in (ONLINE, OFFLINE):
        options = [
            (label, np.array([scores(folder, n, m, settings)[:, 0] for n in names]))
            for m in (theirs, ours)
            for label, settings in candidates(m).items()
        ]
        for label, score in options:
            print(f"{label:86}{pair(score.mean(axis=0))}", flush=True)
        held = []
        for k, name in enumerate(names):
            rest = [np.delete(score, k, axis=0).mean() for _, score in options]
            label, score = options[int(np.argmin(rest))]
            held.append(score[k])
            print(f"without {name:46}{pair(score[k])}  {label}")
        peer = options[0][1].mean(axis=0)
        gain = 100.0 * (1.0 - np.mean(held, axis=0) / peer)
        print(f"held out: {pair(np.mean(held, axis=0))}, {theirs}: {pair(peer)}, better by {pair(gain)} %")


def pair(both):
    return f"{both[0]:.2f} ({both[1]:.2f})"


if __name__ == "__main__":
    main()
