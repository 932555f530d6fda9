"""Plane calibration of 700 lines: time, and against SciPy's finite differences on the same problem.

Run: ``pytest tests/benchmarks/bench_plane.py --benchmark-only -s``. Medians, in the same process.
"""

import time

import numpy as np
from calibration_examples import scan_plane
from scipy.optimize import least_squares

from calibration.chain import CHAIN, PROBE, Chain, residuals_and_jacobian
from calibration.plane import Plane, calibrate_plane, solve

LINES = 700


def median_seconds(function, rounds=7):
    """Median time of a few rounds after one to warm up."""
    function()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def test_seven_hundred_lines(benchmark):
    lines = scan_plane(np.random.default_rng(0), LINES, noisy=True).lines
    found = calibrate_plane(lines).chain
    columns = [CHAIN.index(name) for name in (*PROBE, *Plane().determined)]
    start = found.parameters()
    start[columns] += np.random.default_rng(1).normal(0, 0.02, len(columns)) * np.where(
        np.array(columns) < 2, start[:2].mean(), 1.0
    )

    def residuals(x):
        full = start.copy()
        full[columns] = x
        return residuals_and_jacobian(full, lines, Plane())[0].ravel()

    def differences():
        return least_squares(residuals, start[columns], method="lm", x_scale="jac")

    def solver():
        return solve(lines, Plane(), Chain.from_parameters(start))

    # Both reach the same minimum, up to the frames that the solver leaves out.
    least = np.sqrt(np.mean(differences().fun ** 2))
    assert abs(solver().rms / least - 1.0) < 0.05
    benchmark(calibrate_plane, lines)
    whole, near, theirs = (median_seconds(f) for f in (lambda: calibrate_plane(lines), solver, differences))
    print(f"\n{LINES} lines: {1e3 * whole:.0f} ms from no guess, standard errors included")
    print(f"from a guess {1e3 * near:.0f} ms with outliers looked for and standard errors")
    print(
        f"SciPy's finite differences, without these, {1e3 * theirs:.0f} ms: {theirs / near:.1f} times as long"
    )
