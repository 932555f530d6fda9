"""Drift correction on poses alone: accuracy over many seeds, and the Jacobian against finite differences.

``python tests/benchmarks/bench_drift.py [SEEDS]`` prints the table; ``pytest --benchmark-only`` times.

The image-based poses of a hand-like 20 mm sweep of 150 to 300 frames are 15 % too long and drift by
1.5 degrees of tilt; the tracker has 0.15 mm and 0.1 degrees of noise per axis. Length error is the error of
the accumulated elevational travel of the image centre from the first to the last frame; in a reversal
(20 mm and back) it is that of the forward half. On a busy machine set OPENBLAS_NUM_THREADS=1: the threads
of a small singular value decomposition otherwise wait for each other, half a second for 2 ms of work.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from drifting import CENTRE_MM, CORNERS_MM, drifted, hand_sweep, tracked
from scipy.optimize import least_squares

from speckle3d.correction import drift
from speckle3d.correction.drift import DriftSettings, correct_orientation, correct_pose
from speckle3d.scoring.lengths import accumulated

FIRST_SEED = 90_000
CASES = {
    "20 mm": {},
    "20 mm, 5 % outliers of 2 mm": {"outliers": 0.05},
    "20 mm and back, forward half": {"turns": 1},
    "20 mm, tracker 0.2 mm / 0.2 deg": {"noise_mm": 0.2, "noise_deg": 0.2},
    "3 mm": {"length_mm": 3.0},
}


def errors(poses, truth, last):
    """Length error in % and tilt error in degrees of the frames up to `last`."""
    found, true = accumulated(poses, CENTRE_MM), accumulated(truth, CENTRE_MM)
    length = 100.0 * (found.length_mm[last] / true.length_mm[last] - 1.0)
    return abs(length), abs(np.rad2deg(found.tilt_rad[last] - true.tilt_rad[last]))


def sweep(seed, length_mm=20.0, turns=0, **tracker):
    rng = np.random.default_rng(seed)
    frames = int(rng.integers(150, 301))
    truth = hand_sweep(rng, frames, length_mm, turns)
    return truth, drifted(truth, rng), tracked(truth, rng, **tracker)


def corrections(estimate, reference):
    covered = np.ones(len(estimate), dtype=bool)
    for curves in ("time", "distance"):
        settings = DriftSettings(curves=curves)
        found = correct_pose(estimate, reference, covered, CORNERS_MM, settings)
        yield f"6-DOF {curves}", found.poses
        found = correct_orientation(estimate, reference.rotation, covered, CENTRE_MM, settings)
        yield f"3-DOF {curves}", found.poses


def study(seeds):
    """Rows (case, method, median and 90th percentile of length error %, of tilt error deg)."""
    for case, options in CASES.items():
        collected = {}
        for seed in range(FIRST_SEED, FIRST_SEED + seeds):
            truth, estimate, reference = sweep(seed, **options)
            travelled = accumulated(truth, CENTRE_MM).length_mm
            last = int(np.argmax(np.abs(travelled))) if options.get("turns") else len(truth) - 1
            for method, poses in [("none", estimate), *corrections(estimate, reference)]:
                collected.setdefault(method, []).append(errors(poses, truth, last))
        for method, values in collected.items():
            yield case, method, np.median(values, axis=0), np.percentile(values, 90, axis=0)


def jacobian_ratio(repeats=5):
    """Milliseconds of one correction with the analytic Jacobian and with finite differences, 300 frames."""
    rng = np.random.default_rng(FIRST_SEED)
    truth = hand_sweep(rng, 300)
    estimate, reference = drifted(truth, rng), tracked(truth, rng)
    covered = np.ones(300, dtype=bool)
    analytic, differences = [], []
    for _ in range(repeats):
        analytic.append(_milliseconds(lambda: correct_pose(estimate, reference, covered, CORNERS_MM)))
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(drift, "least_squares", _without_jacobian)
            slow = _milliseconds(lambda: correct_pose(estimate, reference, covered, CORNERS_MM))
        differences.append(slow)
    return min(analytic), min(differences)


def _without_jacobian(residuals, start, jacobian, **options):
    return least_squares(residuals, start, **options)


def _milliseconds(run):
    started = time.perf_counter()
    run()
    return 1e3 * (time.perf_counter() - started)


@pytest.mark.parametrize("analytic", [True, False], ids=["analytic", "finite-differences"])
def test_correction_of_300_frames(benchmark, analytic, monkeypatch):
    rng = np.random.default_rng(FIRST_SEED)
    truth = hand_sweep(rng, 300)
    estimate, reference = drifted(truth, rng), tracked(truth, rng)
    if not analytic:
        monkeypatch.setattr(drift, "least_squares", _without_jacobian)
    benchmark(correct_pose, estimate, reference, np.ones(300, dtype=bool), CORNERS_MM)


def main(seeds: int = 20) -> None:
    print(f"median (90th percentile) of {seeds} seeds")
    print(f"{'case':34} {'correction':15} {'length error %':>16} {'tilt error deg':>18}")
    for case, method, median, high in study(seeds):
        print(f"{case:34} {method:15} {median[0]:7.2f} ({high[0]:5.2f}) {median[1]:10.3f} ({high[1]:5.3f})")
    fast, slow = jacobian_ratio()
    print(f"300 frames: {fast:.0f} ms analytic, {slow:.0f} ms finite differences, ratio {slow / fast:.1f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
