"""Plane calibration from 700 lines: time, and our solver against SciPy's with finite differences.

Run: ``python tests/benchmarks/bench_calibration.py [--runs 15]``. Both solvers minimise the same residual of
eleven parameters from the start that the three-stage method finds, in the same process; medians.
"""

import argparse
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from calibration_examples import PIXEL_MM, TRIAL_1, centre_of, scan_plane

from calibration.chain import CHAIN, PROBE, Chain, ChainSolution, ImagePoints, residuals_and_jacobian
from calibration.plane import Plane, _three_stages, calibrate_plane
from calibration.solver import refined, solve_chain

LINES, TARGET_S = 700, 0.05
FREE = (*PROBE, *Plane().determined)
COLUMNS = [CHAIN.index(name) for name in FREE]


def by_scipy(lines: ImagePoints, start: Chain) -> Chain:
    """Levenberg-Marquardt with finite differences, every line counting: no frame is left out."""
    full = start.parameters()

    def residuals(x: np.ndarray) -> np.ndarray:
        parameters = full.copy()
        parameters[COLUMNS] = x
        return residuals_and_jacobian(parameters, lines, Plane())[0].ravel()

    found = full.copy()
    found[COLUMNS] = least_squares(residuals, full[COLUMNS], jac="2-point", method="lm").x
    return Chain.from_parameters(found)


def by_us(lines: ImagePoints, start: Chain) -> ChainSolution:
    """Analytic derivatives; reweighted first, and frames that contradict the others are looked for."""
    return solve_chain(lines, Plane(), start)


def by_us_once(lines: ImagePoints, start: Chain) -> Chain:
    """The same least squares as SciPy's, nothing else: analytic derivatives, frames on image and plane."""
    return refined(lines, Plane(), start, FREE)


def median_seconds(function, *arguments, runs: int) -> float:
    """Median time after one run to warm up."""
    function(*arguments)
    spent = []
    for _ in range(runs):
        began = time.perf_counter()
        function(*arguments)
        spent.append(time.perf_counter() - began)
    return float(np.median(spent))


def report(runs: int) -> None:
    """Print times, their ratio, and that both solvers find the same."""
    lines = scan_plane(np.random.default_rng(0), LINES, line_noise_mm=0.2).lines
    start = _three_stages(lines, None)[0]
    found = [by_us(lines, start).chain, by_us_once(lines, start), by_scipy(lines, start)]
    centres = [centre_of(chain.sensor_from_image, chain.pixel_mm) for chain in found]
    error = np.linalg.norm(centres[0] - centre_of(TRIAL_1, PIXEL_MM))
    print(f"{LINES} lines, eleven parameters, {os.cpu_count()} cores, median of {runs} runs")
    print(
        f"  centres found are {np.ptp(centres, axis=0).max():.1e} mm apart, and {error:.2f} mm off the truth"
    )
    whole = median_seconds(calibrate_plane, lines, runs=runs)
    print(f"  {1e3 * whole:7.1f} ms  calibrate_plane, all of it", end=" ")
    print(f"(target {1e3 * TARGET_S:g} ms{'!' if whole > TARGET_S else ''}), of which")
    stages = median_seconds(_three_stages, lines, None, runs=runs)
    print(f"  {1e3 * stages:7.1f} ms  first and second stage")
    third = median_seconds(by_us, lines, start, runs=runs)
    print(f"  {1e3 * third:7.1f} ms  third stage: outliers, covariance, condition number; and in it")
    once = median_seconds(by_us_once, lines, start, runs=runs)
    print(f"  {1e3 * once:7.1f} ms  one solution by least squares")
    other = median_seconds(by_scipy, lines, start, runs=runs)
    print(
        f"  {1e3 * other:7.1f} ms  the same by scipy.optimize.least_squares with finite differences", end=" "
    )
    print(f"({other / once:.1f} times ours)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=15)
    report(parser.parse_args().runs)


if __name__ == "__main__":
    main()
