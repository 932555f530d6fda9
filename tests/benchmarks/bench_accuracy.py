"""Accuracy on simulated sweeps of seeds that were never used in development.

Run: ``python tests/benchmarks/bench_accuracy.py [--seeds N] [--workers 2] [--case NAME]``.

Each sweep is reconstructed with curves that were calibrated on phantom sweeps of other seeds, and scored
against the truth as ``speckle3d reconstruct`` scores it; beside it stands the plain method, which correlates
intensity, reads it with the phantom's curves as they are and chains frames. Simulated sweeps are kept in the
cache (about 45 MB and half a minute each); the rest is computed anew. A median beyond its target is marked
with ``!``. Last come how often the claimed deviations of patches and poses hold.
"""

import argparse
import os
import sys
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from unittest.mock import patch

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from cache import DEFAULT, simulated
from options import parsed

from speckle3d.config import Config
from speckle3d.core.geometry import mirrored
from speckle3d.core.reconstruction import FramePairs
from speckle3d.core.relative import RelativePoses
from speckle3d.corrections import correct
from speckle3d.io.curves import read_curves
from speckle3d.io.load import load_sweep
from speckle3d.motion import estimate
from speckle3d.motion.coherence import Coherence
from speckle3d.motion.direction import settle_direction
from speckle3d.motion.planes import fully_developed
from speckle3d.motion.trajectory import solve_trajectory
from speckle3d.phantom_curves import calibrate_curves
from speckle3d.pipeline import track
from speckle3d.scoring.lengths import accumulated, compare_modes
from speckle3d.simulation.presets import SimulationSettings

FIRST_SEED = 1001
SHIPPED = Path(__file__).resolve().parents[2] / "data" / "curves.h5"
VECTORS = 48
STEPPED = {"preset": "stepped", "vectors": VECTORS, "steps": 27, "step_mm": 0.06, "blocks": 6}
TURNING = {"preset": "rotation", "vectors": VECTORS}
CURVE_SEEDS = (11, 12, 13)
CURVE_SWEEPS = (
    *({**STEPPED, "seed": seed} for seed in CURVE_SEEDS),
    {**TURNING, "seed": 14, "turn_deg": 8.0},
    {**TURNING, "seed": 15, "turn_deg": 8.0},
    {**TURNING, "seed": 16, "turn_deg": 20.0, "length_mm": 2.0, "frames": 160},
)
"""What curves are calibrated on, as data/README.md has it."""
MODES = ("image", "orientation", "pose", "fused")
PARTS = ("x", "y", "z", "tilt", "yaw", "roll")

PLAIN = {
    "matching": {"correlate": "intensity"},
    "planes": {"turn_deg_per_mm": 100.0},
}
METHODS: Mapping[str, dict[str, object]] = {
    "ours": {},
    "plain": PLAIN,
    "chained": {},
}
CHAINED = ("plain", "chained")
"""Methods that take each frame's surest pair alone, as published, and solve no graph."""


@dataclass(frozen=True)
class Case:
    """One row group of the table: a preset, its options, and targets as (length %, tilt deg) by mode."""

    name: str
    preset: str
    options: dict[str, object] = field(default_factory=dict)
    targets: dict[str, tuple[float | None, float | None]] = field(default_factory=dict)
    methods: tuple[str, ...] = ("ours", "plain")


ONE_WAY = {"length_mm": 20.0}
CASES = (
    Case(
        "phantom, one way",
        "phantom",
        ONE_WAY,
        {"image": (1.5, 0.5), "orientation": (None, 0.2), "pose": (1.0, 0.1)},
        ("ours", "plain", "chained"),
    ),
    Case("phantom, turned 5 deg in yaw", "rotation", {**ONE_WAY, "turn_axis": "yaw"}, {"image": (4.0, 1.0)}),
    Case(
        "tissue, one way",
        "tissue",
        ONE_WAY,
        {"image": (2.0, 1.5), "orientation": (3.0, 0.2)},
        ("ours", "plain", "chained"),
    ),
    Case("tissue, 8 mm", "tissue", {"length_mm": 8.0}, {"image": (3.0, 1.5)}),
)


@dataclass(frozen=True)
class Score:
    """Errors of one mode in one monotone part of one sweep."""

    seed: int
    method: str
    part: str
    mode: str
    length_percent: float
    tilt_deg: float
    yaw_deg: float


@dataclass(frozen=True)
class Result:
    """What one sweep gave.

    `jitter_mm` is the rms error of steps between frames; `standard_poses` (m, 6) and `standard_patches` (m,)
    are errors over their claimed deviations.
    """

    method: str
    scores: tuple[Score, ...]
    direction: str
    jitter_mm: float
    standard_poses: np.ndarray
    standard_patches: np.ndarray


def align_sign(poses, truth, centre_mm):
    """Mirror a sensorless reconstruction that moves the other way than the truth.

    Images alone cannot tell a sweep from its mirror image in the first frame's plane, (z, tilt, yaw) ->
    (-z, -tilt, -yaw): scored as they come, half the sweeps would score that convention and not the method.
    """
    found, true = (accumulated(each, centre_mm).length_mm for each in (poses, truth))
    if (found - found.mean()) @ (true - true.mean()) >= 0.0:
        return poses
    return poses[0] * mirrored(poses[0].inv() * poses)


def of_phantom(problem, *_others):
    """Fully developed speckle, whatever the sweep shows."""
    return Coherence(np.zeros(1), *fully_developed(len(problem.patches)))


def chained(pairs, *others, **named):
    """Trajectory from each frame's surest pair alone."""
    _, best = np.unique(pairs.second[order := np.argsort(pairs.covariance[:, 2, 2])], return_index=True)
    columns = (pairs.first, pairs.second, pairs.poses, pairs.covariance)
    return solve_trajectory(RelativePoses(*(column[order[best]] for column in columns)), *others, **named)


def measure(case, method, seed, curves, folder):
    """Reconstruct and score one sweep of a case."""
    sweep = load_sweep(simulated(_settings({"preset": case.preset, "seed": seed, **case.options}), folder))
    config = Config.model_validate(METHODS[method])
    pairs: list[FramePairs] = []
    with ExitStack() as patches:
        if method in CHAINED:
            patches.enter_context(patch.object(estimate, "solve_trajectory", chained))
        if method == "plain":
            patches.enter_context(patch.object(estimate, "estimate_coherence", of_phantom))
        tracked = track(sweep, curves, config, sink=pairs.append)
    centre = sweep.grid.centre_mm
    poses = {"image": align_sign(tracked.image, sweep.truth, centre)}
    poses |= {mode: c.poses for mode, c in correct(tracked, sweep, MODES[1:], config).items()}
    rows = compare_modes(poses, sweep.truth, centre, end_frames=1)
    scores = [
        Score(seed, method, r.part, r.mode, r.length_error_percent, r.tilt_error_deg, r.yaw_error_deg)
        for r in rows
    ]
    error = accumulated(poses["image"], centre).length_mm - accumulated(sweep.truth, centre).length_mm
    return Result(
        method,
        tuple(scores),
        _direction_without_tracker(sweep, poses["image"], config),
        float(np.sqrt(np.mean(np.diff(error) ** 2))),
        _standard_poses(sweep, tracked.image, tracked.covariance),
        np.concatenate([_standard_patches(sweep, some) for some in pairs]),
    )


def _settings(options):
    return SimulationSettings.model_validate({"vectors": VECTORS, **options})


def _direction_without_tracker(sweep, image, config):
    """Whether a sweep without a tracker would have got its sign right; `image` has the true one."""
    alone = replace(sweep, tracker=None, truth=None)
    sign, source = settle_direction(alone, image, config.sensors)
    if source == "assumed":
        return "undecided"
    # The verdict must not depend on which of the two mirror images is asked about.
    assert settle_direction(alone, mirrored(image), config.sensors)[0] == -sign
    return "right" if sign > 0 else "wrong"


def _standard_poses(sweep, image, covariance):
    """Errors of every eighth pose over their deviations, shape (m, 6)."""
    centre, true = sweep.grid.centre_mm, sweep.truth[0].inv() * sweep.truth
    turned = (image.rotation * true.rotation.inv()).as_rotvec()
    error = np.hstack([image.apply(centre) - true.apply(centre), turned])
    return (error[8::8] / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[8::8])).astype(np.float32)


def _standard_patches(sweep, pairs):
    """Errors of the distances of patches over their deviations."""
    found = []
    for i, j, pose, d, sigma in zip(
        pairs.first, pairs.second, pairs.first_from_second, pairs.distance_mm, pairs.sigma_mm, strict=True
    ):
        at = np.pad(pairs.patch_centre_mm - pose[:2, 3], ((0, 0), (0, 1)))
        z = (sweep.truth[int(i)].inv() * sweep.truth[int(j)]).apply(at)[:, 2]
        found.append((d - np.abs(z)) / sigma)
    values = np.concatenate(found)
    return values[np.isfinite(values)].astype(np.float32)


def curves_of(folder, method="ours"):
    """Curves of the default probe, as data/README.md makes them."""
    sweeps = [load_sweep(simulated(_settings(options), folder)) for options in CURVE_SWEEPS]
    return calibrate_curves(sweeps, Config.model_validate(METHODS[method]))


def report(case, results):
    """Print the table of one case, a row for each mode and method."""
    print(f"\n{case.name}: {len(results) // len(case.methods)} sweeps of {VECTORS} vectors")
    print(f"  {'':29}{'length error %':>29} {'tilt error deg':>29} {'yaw deg':>9}")
    print(
        f"  {'':29}{'median   worst (seed)  target':>29} {'median   worst (seed)  target':>29} {'median':>9}"
    )
    for mode in MODES:
        for method in case.methods:
            mine = [s for r in results for s in r.scores if s.mode == mode and s.method == method]
            length_goal, tilt_goal = (
                case.targets.get(mode, (None, None)) if method == "ours" else (None, None)
            )
            length = _column([(abs(s.length_percent), s.seed) for s in mine], length_goal)
            tilt = _column([(abs(s.tilt_deg), s.seed) for s in mine], tilt_goal)
            yaw = np.median(np.abs([s.yaw_deg for s in mine]))
            print(f"  {mode:12}{method:17}{length:>29} {tilt:>29} {yaw:9.2f}")
    for method in case.methods:
        mine = [r for r in results if r.method == method]
        jitter = 1e3 * np.median([r.jitter_mm for r in mine])
        print(f"  {method}: steps wrong by {jitter:.1f} um rms")
    told = [r.direction for r in results if r.method == "ours"]
    shares = ", ".join(f"{word} in {told.count(word)}" for word in ("right", "wrong", "undecided"))
    print(f"  sign of the motion from the orientation sensor alone: {shares}")
    _report_coverage([r for r in results if r.method == "ours"])


def _report_coverage(results):
    """Share of errors within the claimed 68 % and 95 % intervals."""
    patches = np.concatenate([r.standard_patches for r in results])
    poses = np.concatenate([r.standard_poses for r in results])
    cells = [f"patches {_coverage(patches)}"]
    cells += [f"{name} {_coverage(column)}" for name, column in zip(PARTS, poses.T, strict=True)]
    print(f"  within 68 / 95 % intervals: {', '.join(cells)}; all of the pose {_coverage(poses.ravel())}")


def _coverage(standard):
    inside = [100 * np.mean(np.abs(standard) < limit) for limit in (1.0, 1.96)]
    return f"{inside[0]:.0f} / {inside[1]:.0f}"


def _column(values, goal):
    """A cell of median, worst, its seed, and the target (on the median)."""
    median = float(np.median([v for v, _ in values]))
    worst, seed = max(values)
    target = "-" if goal is None else f"{goal:.2f}{'!' if median > goal + 1e-9 else ' '}"
    return f"{median:.2f} {worst:7.2f} ({seed}) {target:>7}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=8, help="how many")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="the first of them")
    parser.add_argument("--workers", type=int, default=2, help="sweeps at a time, a process each")
    parser.add_argument("--case", default="", help="only cases whose name holds this")
    parser.add_argument("--cache", type=Path, default=DEFAULT)
    options = parsed(parser, seeds=1, case="tissue, 8 mm")
    began = time.perf_counter()
    # What only reads a sweep differently shares the curves of ours.
    cases = [case for case in CASES if options.case in case.name]
    if options.quick:
        curves = {"ours": read_curves(SHIPPED)}
        cases = [replace(case, methods=("ours",)) for case in cases]
    else:
        curves = {method: curves_of(options.cache, method) for method in ("ours", "plain")}
    seeds = range(options.first, options.first + options.seeds)
    print(f"seeds {seeds[0]} to {seeds[-1]}; curves from other sweeps, of seeds 11 to 16")
    # Spawned, not forked: numba's threads do not survive a fork.
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        for case in cases:
            waiting = [
                pool.submit(measure, case, method, seed, curves.get(method, curves["ours"]), options.cache)
                for method in case.methods
                for seed in seeds
            ]
            results = []
            for future in waiting:
                results.append(future.result())
                print(f"\r{case.name}: {len(results)} of {len(waiting)}", end="", file=sys.stderr, flush=True)
            print(file=sys.stderr)
            report(case, results)
    print(f"\n{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
