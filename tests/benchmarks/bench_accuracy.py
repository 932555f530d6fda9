"""Accuracy on simulated sweeps of seeds that were never used in development.

Run: ``python tests/benchmarks/bench_accuracy.py [--seeds N] [--workers 2] [--case NAME] [--plain]``.

Each sweep is reconstructed with curves that were calibrated on stepped sweeps of other seeds, and scored
against the truth as ``speckle3d reconstruct`` scores it. Simulated sweeps are kept in the cache (about 45 MB
and a minute each); the rest is computed anew. A value beyond its target is marked with ``!``.
"""

import argparse
import json
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import bench_drift
import numpy as np
from cache import DEFAULT, simulated
from scipy.spatial.transform import RigidTransform

from speckle3d.config import Config
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.geometry import mirrored
from speckle3d.direction import settle_direction
from speckle3d.io.load import load_sweep
from speckle3d.pipeline import calibrate_curves, correct, track
from speckle3d.simulation.presets import SimulationSettings
from speckle3d.study.metrics import align_sign, compare_modes

FIRST_SEED = 1001
CURVE_SEEDS = (11, 12, 13)
VECTORS = 48
STEPPED = {"preset": "stepped", "vectors": VECTORS, "steps": 27, "step_mm": 0.06, "blocks": 6}
MODES = ("image", "orientation", "pose")


@dataclass(frozen=True)
class Case:
    """One row group of the table: a preset, its options, and targets as (length %, tilt deg) by mode.

    A target of None is not set; "image" stands for that of the image-only mode in the same case.
    """

    name: str
    preset: str
    options: dict[str, object] = field(default_factory=dict)
    targets: dict[str, tuple[float | str | None, float | None]] = field(default_factory=dict)


CASES = (
    Case(
        "phantom, 20 mm one way",
        "phantom",
        {"length_mm": 20.0},
        {"image": (3.0, 1.0), "orientation": ("image", 0.2), "pose": (1.0, 0.1)},
    ),
    Case("phantom, turned 5 deg in yaw", "rotation", {"length_mm": 20.0, "turn_axis": "yaw"}),
    Case("phantom, turned 5 deg in tilt", "rotation", {"length_mm": 20.0}),
    Case("tissue, 20 mm one way", "tissue", {"length_mm": 20.0}),
    Case("tissue, forward and back", "reversal", {"length_mm": 20.0}),
)


@dataclass(frozen=True)
class Score:
    """Errors of one mode in one monotone part of one sweep."""

    seed: int
    part: str
    mode: str
    length_percent: float
    tilt_deg: float
    yaw_deg: float


@dataclass(frozen=True)
class Result:
    """What one sweep gave; `direction` is what the orientation sensor alone made of the sign."""

    scores: tuple[Score, ...]
    direction: str


def measure(case: Case, seed: int, curves: DecorrelationCurves, folder: Path, plain: bool) -> Result:
    """Reconstruct and score one sweep of a case."""
    settings = SimulationSettings(preset=case.preset, seed=seed, **{"vectors": VECTORS, **case.options})
    sweep = load_sweep(simulated(settings, folder))
    config = Config.model_validate({"coherence": {"adapt": not plain}})
    tracked = track(sweep, curves, config)
    corrected = correct(tracked, sweep, MODES[1:], config)
    centre = sweep.grid.centre_mm
    poses = {"image": align_sign(tracked.image, sweep.truth, centre)}
    poses |= {mode: correction.poses for mode, correction in corrected.items()}
    rows = compare_modes(poses, sweep.truth, centre, end_frames=1)
    scores = [
        Score(seed, r.part, r.mode, r.length_error_percent, r.tilt_error_deg, r.yaw_error_deg) for r in rows
    ]
    return Result(tuple(scores), _direction_without_tracker(sweep, poses["image"], config))


def _direction_without_tracker(sweep, image: RigidTransform, config: Config) -> str:
    """Whether a sweep without a tracker would have got its sign right; `image` has the true one."""
    alone = replace(sweep, tracker=None, truth=None)
    sign, source = settle_direction(alone, image, config)
    if source == "assumed":
        return "undecided"
    # The verdict must not depend on which of the two mirror images is asked about.
    assert settle_direction(alone, mirrored(image), config)[0] == -sign
    return "right" if sign > 0 else "wrong"


def curves_of(folder: Path) -> DecorrelationCurves:
    """Curves of the default probe, as data/README.md makes them."""
    sweeps = [load_sweep(simulated(SimulationSettings(seed=s, **STEPPED), folder)) for s in CURVE_SEEDS]
    return calibrate_curves(sweeps)


def report(case: Case, results: list[Result]) -> None:
    """Print the table of one case, worst seeds named."""
    scores = [score for result in results for score in result.scores]
    print(f"\n{case.name}: {len(results)} sweeps of {VECTORS} vectors")
    print(f"  {'mode':12} {'length error %':>28} {'tilt error deg':>28} {'yaw error deg':>16}")
    print(f"  {'':12} {'median   worst (seed) target':>28} {'median   worst (seed) target':>28}", end="")
    print(f" {'median   worst':>16}")
    length_of_image = np.inf
    for mode in MODES:
        mine = [score for score in scores if score.mode == mode]
        length_goal, tilt_goal = case.targets.get(mode, (None, None))
        if length_goal == "image":
            length_goal = length_of_image
        length, text = _column([(abs(s.length_percent), s.seed) for s in mine], length_goal)
        length_of_image = length if mode == "image" else length_of_image
        _, tilt = _column([(abs(s.tilt_deg), s.seed) for s in mine], tilt_goal)
        yaw = np.abs([s.yaw_deg for s in mine])
        print(f"  {mode:12} {text:>28} {tilt:>28} {np.median(yaw):8.2f} {yaw.max():7.2f}")
    told = [result.direction for result in results]
    shares = ", ".join(f"{word} in {told.count(word)}" for word in ("right", "wrong", "undecided"))
    print(f"  sign of the motion from the orientation sensor alone: {shares}")


def _column(values: list[tuple[float, int]], goal: float | None) -> tuple[float, str]:
    """The median, and a cell of median, worst, its seed, and the target (on the median)."""
    median = float(np.median([v for v, _ in values]))
    worst, seed = max(values)
    target = "-" if goal is None else f"{goal:.2f}{'!' if median > goal + 1e-9 else ' '}"
    return median, f"{median:.2f} {worst:7.2f} ({seed}) {target:>6}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=8, help=f"how many, from {FIRST_SEED} on")
    parser.add_argument("--workers", type=int, default=2, help="sweeps at a time, a process each")
    parser.add_argument("--case", default="", help="only cases whose name holds this")
    parser.add_argument("--plain", action="store_true", help="phantom curves alone, no adaptation to tissue")
    parser.add_argument("--cache", type=Path, default=DEFAULT)
    parser.add_argument("--json", type=Path, help="also write every score to this file")
    options = parser.parse_args()
    began = time.perf_counter()
    curves = curves_of(options.cache)
    seeds = range(FIRST_SEED, FIRST_SEED + options.seeds)
    print(f"seeds {seeds[0]} to {seeds[-1]}; curves from stepped sweeps of seeds {CURVE_SEEDS}")
    every = {}
    # Spawned, not forked: numba's threads do not survive a fork.
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        for case in [c for c in CASES if options.case in c.name]:
            waiting = [
                pool.submit(measure, case, seed, curves, options.cache, options.plain) for seed in seeds
            ]
            results = []
            for future in waiting:
                results.append(future.result())
                print(f"\r{case.name}: {len(results)} of {len(seeds)}", end="", file=sys.stderr, flush=True)
            print(file=sys.stderr)
            report(case, results)
            every[case.name] = [vars(score) for result in results for score in result.scores]
    if not options.case:
        print("\ncorrections alone, on drift put on true poses (bench_drift.py):")
        bench_drift.main()
    print(f"\n{time.perf_counter() - began:.0f} s")
    if options.json:
        options.json.write_text(json.dumps(every, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
