"""Plane calibration from 700 lines: time, and our solver against SciPy's with finite differences.

Run: ``python tests/benchmarks/bench_calibration.py [--runs 15]``. Both solvers minimise the same residual of
eleven parameters from one start, in the same process; medians, and processor time beside them.
"""

import argparse
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.optimize import least_squares as by_scipy

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from calibration_examples import PIXEL_MM, TRIAL_1, centre_of, scan_plane

from calibration.plane import Equations, Plane, calibrate_plane, least_squares
from calibration.points import CHAIN, columns_of

LINES, TARGET_S = 700, 0.05


def differences(equations, start, free):
    """Levenberg-Marquardt with finite differences of the same small displacements."""
    columns = columns_of(free)

    def moved(x):
        step = np.zeros(len(CHAIN))
        step[columns] = x
        return start.displaced(step)

    found = by_scipy(
        lambda x: equations.residuals(moved(x)).ravel(), np.zeros(len(free)), jac="2-point", method="lm"
    )
    return moved(found.x)


def median_seconds(function, *arguments, runs):
    """Median wall-clock and processor time after one run to warm up."""
    function(*arguments)
    spent = []
    for _ in range(runs):
        began = time.perf_counter(), time.process_time()
        function(*arguments)
        spent.append((time.perf_counter() - began[0], time.process_time() - began[1]))
    return np.median(spent, axis=0)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=15)
    runs = parser.parse_args().runs
    lines = scan_plane(np.random.default_rng(0), LINES, line_noise_mm=0.2).lines
    solution, equations = calibrate_plane(lines), Equations.of(lines, Plane())
    start = solution.chain.displaced(np.append(np.full(5, 0.01), np.full(9, 0.02)))
    found = [solve(equations, start, solution.free) for solve in (least_squares, differences)]
    centres = [centre_of(chain.sensor_from_image, chain.pixel_mm) for chain in found]
    error = np.linalg.norm(centres[0] - centre_of(TRIAL_1, PIXEL_MM))
    print(f"{LINES} lines, eleven parameters, median of {runs} runs; in brackets of the processor")
    print(f"  centres are {np.ptp(centres, axis=0).max():.1e} mm apart, and {error:.2f} mm off the truth")
    whole = 1e3 * median_seconds(calibrate_plane, lines, runs=runs)
    print(f"  {whole[0]:7.1f} ms ({whole[1]:.1f})  calibrate_plane (target {1e3 * TARGET_S:g} ms)")
    ours, theirs = (
        1e3 * median_seconds(solve, equations, start, solution.free, runs=runs)
        for solve in (least_squares, differences)
    )
    print(f"  {ours[0]:7.1f} ms ({ours[1]:.1f})  one solution by least squares")
    print(f"  {theirs[0]:7.1f} ms ({theirs[1]:.1f})  by finite differences: {theirs[1] / ours[1]:.1f} times")


if __name__ == "__main__":
    main()
