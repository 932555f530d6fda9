"""How well images alone can tell tilt: the Cramer-Rao bound of the default probe.

Run: ``python tests/benchmarks/bench_tilt.py`` (seconds; uses data/curves.h5).

A pair of frames a distance d apart tells its tilt from how that distance differs from depth to depth, by
the levers between the depths and their pivots (`TiltResponse`). A sweep of length L holds L / d independent
pairs, each with the Cramer-Rao deviation of every patch, so the tilt that grows in proportion to the way
is known to no better than the printed deviations; the best d is taken. Beside them: what would be if speckle
turned about the depth it is at (levers as long as depths), and what the hand's own wander is.
"""

from pathlib import Path

import numpy as np

from speckle3d.core.sweep import ImageGrid
from speckle3d.io.curves import read_curves
from speckle3d.matching.patches import lay_patches
from speckle3d.motion.distances import DistanceEstimator
from speckle3d.simulation.movement import HandMotion

CURVES = Path(__file__).resolve().parents[2] / "data" / "curves.h5"
LENGTH_MM = 20.0
DISTANCES_MM = np.arange(0.1, 1.0, 0.05)
CURVE_ERROR = 0.005
"""Relative error of distances that differs from depth to depth, for curves from some twenty blocks."""


def tilt_deviation(vectors: int, lever: str) -> tuple[float, float]:
    """Deviation of a sweep's tilt, degrees: from speckle alone, and with the curves' own error."""
    grid = ImageGrid(vectors, 3818, 0.3, 0.01155)
    patches, curves = lay_patches(grid), read_curves(CURVES)
    estimator = DistanceEstimator(curves, patches)
    depth = patches.centre_mm[:, 1]
    arm = depth - estimator.tilt.pivot_mm if lever == "pivot" else depth
    best, spread = np.inf, 0.0
    for d in DISTANCES_MM:
        weight = 1 / estimator.sigma(np.full(depth.size, d)) ** 2
        off = arm - np.average(arm, weights=weight)
        rate = 1 / np.sqrt((weight * off**2).sum()) / d / np.sqrt(LENGTH_MM / d)
        if rate < best:
            best, spread = rate, float(np.sqrt(np.average(off**2, weights=weight)))
    rows = np.unique(depth).size
    false = CURVE_ERROR / spread / np.sqrt(rows)
    return tuple(float(np.rad2deg(r * LENGTH_MM)) for r in (best, np.hypot(best, false)))


def main() -> None:
    wander = np.rad2deg(HandMotion().wander_rad)
    print(f"tilt over {LENGTH_MM:g} mm, deg: least standard deviation from images alone")
    for vectors in (48, 127):
        for lever, name in (("pivot", "as the beam is"), ("depth", "if speckle turned with its depth")):
            speckle, curves = tilt_deviation(vectors, lever)
            print(f"  {vectors:3} vectors, {name:33} {speckle:5.2f}   with the curves' error {curves:5.2f}")
    print(f"  the simulated hand's slow wander: {wander:.2f} at any time, {2**0.5 * wander:.2f} between two")


if __name__ == "__main__":
    main()
