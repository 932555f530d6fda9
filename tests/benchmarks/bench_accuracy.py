"""Accuracy on simulated sweeps of seeds that were never used in development.

Run: ``python tests/benchmarks/bench_accuracy.py [--seeds N] [--workers 2] [--case NAME]``.

Each sweep is reconstructed with curves that were calibrated on phantom sweeps of other seeds, and scored
against the truth as ``speckle3d reconstruct`` scores it. Simulated sweeps are kept in the cache (about 45
MB and half a minute each); the rest is computed anew. Last come how often the claimed deviations of patches
and poses hold.
"""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import bench
import numpy as np
from cache import DEFAULT, sweep_file

from speckle3d.config import Config
from speckle3d.corrections import correct
from speckle3d.io.family.curves import read_curves
from speckle3d.io.load import load_sweep
from speckle3d.motion.sensors import settle_direction
from speckle3d.phantom_curves import calibrate_curves
from speckle3d.scoring.lengths import compare_modes, sum_motion
from speckle3d.simulation.presets import SimulationSettings
from speckle3d.tracking import track

FIRST_SEED = 1001
CURVES_FILE = bench.DATA / "curves.h5"
VECTORS = 48
STEPS = {"preset": "stepped", "steps": 27, "step_mm": 0.06, "blocks": 6}
CURVE_SWEEPS = (
    *({**STEPS, "seed": seed} for seed in (11, 12, 13)),
    {"preset": "rotation", "seed": 14, "turn_deg": 8.0},
    {"preset": "rotation", "seed": 15, "turn_deg": 8.0},
    {"preset": "rotation", "seed": 16, "turn_deg": 20.0, "length_mm": 2.0, "frames": 160},
)
"""What curves are calibrated on, as data/README.md has it."""
MODES = ("image", "orientation", "pose", "fused")
PARTS = ("x", "y", "z", "tilt", "yaw", "roll")
CASES = {
    "phantom, one way": {"preset": "phantom"},
    "phantom, turned 5 deg in yaw": {"preset": "rotation", "turn_axis": "yaw"},
    "tissue, one way": {"preset": "tissue"},
    "tissue, 8 mm": {"preset": "tissue", "length_mm": 8.0},
}


@dataclass(frozen=True)
class Result:
    """What one sweep gave.

    `jitter_mm` is the rms error of steps between frames; `poses` (m, 6) and `patches` (m,) are errors over
    their claimed deviations.
    """

    seed: int
    rows: list
    direction: str
    jitter_mm: float
    poses: np.ndarray
    patches: np.ndarray


def settings_of(options):
    return SimulationSettings.model_validate({"vectors": VECTORS, **options})


def curves_of(folder):
    """Curves of the default probe, as data/README.md makes them."""
    return calibrate_curves([load_sweep(sweep_file(settings_of(o), folder)) for o in CURVE_SWEEPS])


def measure(options, curves, folder, seed):
    """Reconstruct and score one sweep of a case."""
    sweep = load_sweep(sweep_file(settings_of({**options, "seed": seed}), folder))
    centre, pairs = sweep.grid.centre_mm, []
    tracking = track(sweep, curves, sink=pairs.append)
    poses = {"image": tracking.image}
    poses |= {mode: m.poses for mode, m in correct(tracking, sweep, MODES[1:]).items()}
    length, true = (sum_motion(p, centre).length_mm for p in (tracking.image, sweep.truth))
    return Result(
        seed,
        compare_modes(poses, sweep.truth, centre, end_frames=1),
        _direction_without_tracker(sweep, tracking.image),
        float(np.sqrt(np.mean(np.diff(length - true) ** 2))),
        _standard_poses(sweep, tracking),
        np.concatenate([_standard_patches(sweep, table) for table in pairs]),
    )


def _direction_without_tracker(sweep, image):
    """Whether a sweep without a tracker would have got its sign right; `image` has the true one."""
    sign, source = settle_direction(replace(sweep, tracker=None, truth=None), image, Config().sensors)
    return "undecided" if source == "assumed" else "right" if sign > 0 else "wrong"


def _standard_poses(sweep, tracking):
    """Errors of every eighth pose over their deviations, shape (m, 6)."""
    centre, true, image = sweep.grid.centre_mm, sweep.truth[0].inv() * sweep.truth, tracking.image
    rotation = (image.rotation * true.rotation.inv()).as_rotvec()
    error = np.hstack([image.apply(centre) - true.apply(centre), rotation])
    return (error / np.sqrt(np.maximum(np.diagonal(tracking.covariance, axis1=1, axis2=2), 1e-30)))[8::8]


def _standard_patches(sweep, pairs):
    """Errors of the distances of patches over their deviations."""
    errors = []
    for i, j, pose, d, sigma in zip(
        pairs.first, pairs.second, pairs.first_from_second, pairs.distance_mm, pairs.sigma_mm, strict=True
    ):
        at = np.pad(pairs.patch_centre_mm - pose[:2, 3], ((0, 0), (0, 1)))
        z = (sweep.truth[int(i)].inv() * sweep.truth[int(j)]).apply(at)[:, 2]
        errors.append((d - np.abs(z)) / sigma)
    values = np.concatenate(errors)
    return values[np.isfinite(values)]


def report(case, results):
    """Print the table of one case, a row for each mode."""
    print(f"\n{case}: {len(results)} sweeps of {VECTORS} vectors; absolute errors: median, worst (seed)")
    for mode in MODES:
        rows = [(row, result.seed) for result in results for row in result.rows if row.mode == mode]
        cells = []
        for name in ("length_error_percent", "tilt_error_deg", "yaw_error_deg"):
            errors = [(abs(getattr(row, name)), seed) for row, seed in rows]
            worst, seed = max(errors)
            cells.append(f"{np.median([error for error, _ in errors]):8.2f} {worst:6.2f} ({seed})")
        print(f"  {mode:12} length, % {cells[0]}   tilt, deg {cells[1]}   yaw {cells[2]}")
    print(f"  steps wrong by {1e3 * np.median([r.jitter_mm for r in results]):.1f} um rms")
    words = [r.direction for r in results]
    shares = ", ".join(f"{word} in {words.count(word)}" for word in ("right", "wrong", "undecided"))
    print(f"  sign of the motion from the orientation sensor alone: {shares}")
    poses = np.concatenate([r.poses for r in results])
    shares = {"patches": np.concatenate([r.patches for r in results])}
    shares |= dict(zip(PARTS, poses.T, strict=True)) | {"all of the pose": poses}
    print("  within 68 / 95 % intervals: " + ", ".join(f"{k} {_coverage(v)}" for k, v in shares.items()))


def _coverage(standard):
    inside = [100 * np.mean(np.abs(standard) < limit) for limit in (1.0, 1.96)]
    return f"{inside[0]:.0f} / {inside[1]:.0f}"


def main():
    parser = bench.parser_of(__doc__)
    parser.add_argument("--seeds", type=int, default=8, help="how many")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="the first of them")
    parser.add_argument("--workers", type=int, default=2, help="sweeps at a time, a process each")
    parser.add_argument("--case", default="", help="only cases whose name holds this")
    parser.add_argument("--cache", type=Path, default=DEFAULT)
    options = bench.parse_options(parser, seeds=1, case="tissue, 8 mm", workers=1)
    curves = read_curves(CURVES_FILE) if options.quick else curves_of(options.cache)
    seeds = range(options.first, options.first + options.seeds)
    print(f"seeds {seeds[0]} to {seeds[-1]}; curves from other sweeps, of seeds 11 to 16")
    # Spawned, not forked: numba's threads do not survive a fork.
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        for case, of_case in CASES.items():
            if options.case in case:
                if options.quick:
                    of_case = {**of_case, "length_mm": 3.0, "vectors": 24}
                report(case, list(pool.map(partial(measure, of_case, curves, options.cache), seeds)))


if __name__ == "__main__":
    main()
