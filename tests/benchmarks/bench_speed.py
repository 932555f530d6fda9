"""Speed of the whole pipeline and memory of a long sweep, on frames of 127 vectors by 3818 samples.

Run: ``python tests/benchmarks/bench_speed.py [--runs 5]`` for speed, with the correlation stage beside two
ways to do the same with SciPy and NumPy in the same process; ``... --memory`` for the peak resident memory
of ``speckle3d reconstruct`` on 2,000 frames.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from bench_accuracy import curves_of
from cache import DEFAULT, simulated, to_and_fro
from scipy.signal import correlate

from speckle3d.config import Config
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.corrections import correct
from speckle3d.io.curves import write_curves
from speckle3d.io.load import load_sweep
from speckle3d.kernels.correlation import patch_correlations
from speckle3d.matching.matcher import FrameMatcher, ReadyFrame
from speckle3d.matching.patches import PatchGrid
from speckle3d.pipeline import track
from speckle3d.simulation.presets import SimulationSettings

SWEEP = SimulationSettings(preset="phantom", seed=2001, length_mm=7.5, frames=60)
LONG_FRAMES = 2000
TARGET_FRAMES_S, TARGET_GB = 25.0, 1.5
LAGS = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])


def pipeline(path: Path, curves: DecorrelationCurves) -> tuple[float, dict[str, float]]:
    """Seconds from a file to corrected trajectories, and those of each stage."""
    began = time.perf_counter()
    sweep = load_sweep(path)
    tracked = track(sweep, curves)
    then = time.perf_counter()
    correct(tracked, sweep, ["orientation", "pose"])
    ended = time.perf_counter()
    return ended - began, {**tracked.times.seconds, "drift correction, two modes": ended - then}


def report_pipeline(path: Path, curves: DecorrelationCurves, runs: int) -> None:
    """Print frames per second and the share of each stage, the first run (compiling) left out."""
    frames = len(load_sweep(path))
    pipeline(path, curves)
    results = sorted((pipeline(path, curves) for _ in range(runs)), key=lambda r: r[0])
    seconds, stages = results[len(results) // 2]
    print(f"{frames} frames of {SWEEP.vectors} x {SWEEP.samples}, {os.cpu_count()} cores, {runs} runs")
    print(f"  {frames / seconds:.1f} frames/s (median; {frames / results[-1][0]:.1f} to", end=" ")
    print(f"{frames / results[0][0]:.1f}), reading and two drift corrections included; ", end="")
    print(f"target {TARGET_FRAMES_S:g}{'!' if frames / seconds < TARGET_FRAMES_S else ''}")
    for stage, spent in sorted(stages.items(), key=lambda item: -item[1]):
        print(f"  {100 * spent / seconds:5.1f} %  {stage}")
    print("  (reading and intensity run on a second core: shares need not add up to 100 %)")


def report_correlation(path: Path, runs: int) -> None:
    """Print the correlation kernel's time for one frame pair beside SciPy's and NumPy's."""
    sweep, config = load_sweep(path), Config()
    matcher = FrameMatcher(sweep, config.intensity, config.patches, config.inplane)
    fixed, moving = (matcher.prepare(matcher.echo(sweep.frames[i])) for i in (0, 1))
    ways = {"this package": by_kernel, "numpy, lag by lag": by_numpy, "scipy.signal.correlate": by_scipy}
    values = {name: way(fixed, moving, matcher.patches) for name, way in ways.items()}
    ours = values["this package"]
    for name, value in values.items():
        assert np.nanmax(np.abs(value - ours)) < 1e-4, name
    spent = {name: _median_seconds(way, fixed, moving, matcher.patches, runs) for name, way in ways.items()}
    print(f"\ncorrelation of {len(matcher.patches)} patches at 9 lags, one frame pair, one core")
    for name, seconds in spent.items():
        print(f"  {1e3 * seconds:7.2f} ms  {name} ({seconds / spent['this package']:.1f} times ours)")


def by_kernel(fixed: ReadyFrame, moving: ReadyFrame, patches: PatchGrid) -> np.ndarray:
    rho = np.empty((len(patches), 3, 3))
    lag = np.zeros((len(patches), 2), dtype=np.int64)
    patch_correlations(fixed.image, moving.image, patches.first, patches.size, lag, 0.5, rho)
    return _inner(rho.reshape(-1, 9), fixed, patches)


def by_numpy(fixed: ReadyFrame, moving: ReadyFrame, patches: PatchGrid) -> np.ndarray:
    """Pearson's coefficient of whole patches, all of them at once for each lag."""
    flat = _whole(fixed.image, patches, (0, 0))
    rho = np.empty((len(patches), 9))
    for k, lag in enumerate(LAGS):
        rho[:, k] = np.einsum("pk,pk->p", flat, _whole(moving.image, patches, lag))
    return _inner(rho, fixed, patches)


def by_scipy(fixed: ReadyFrame, moving: ReadyFrame, patches: PatchGrid) -> np.ndarray:
    """Normalised correlation of each patch with its neighbourhood, sums of squares by the same routine."""
    rho = np.full((len(patches), 9), np.nan)
    n = patches.size.prod()
    ones = np.ones(patches.size, dtype=np.float32)
    for p, (v, s) in enumerate(patches.first):
        if not _is_inner(patches.first[p], patches.size, fixed.image.shape):
            continue
        a = fixed.image[v : v + patches.size[0], s : s + patches.size[1]].astype(np.float64)
        a -= a.mean()
        b = moving.image[v - 1 : v + patches.size[0] + 1, s - 1 : s + patches.size[1] + 1].astype(np.float64)
        covariance = correlate(b, a, "valid")
        total, square = correlate(b, ones, "valid"), correlate(b * b, ones, "valid")
        rho[p] = (covariance / np.sqrt((a * a).sum() * (square - total**2 / n))).ravel()
    return rho


def _whole(image: np.ndarray, patches: PatchGrid, lag: tuple[int, int]) -> np.ndarray:
    """Patches displaced by a lag, less their mean and of unit norm, shape (p, samples of a patch)."""
    rows, columns = (np.arange(n) for n in patches.size)
    v = np.clip(patches.first[:, :1] + rows + lag[0], 0, image.shape[0] - 1)
    s = np.clip(patches.first[:, 1:] + columns + lag[1], 0, image.shape[1] - 1)
    flat = image[v[:, :, None], s[:, None, :]].reshape(len(patches), -1)
    flat -= flat.mean(axis=1, keepdims=True)
    return flat / np.linalg.norm(flat, axis=1, keepdims=True)


def _inner(rho: np.ndarray, fixed: ReadyFrame, patches: PatchGrid) -> np.ndarray:
    """Only patches whose every lag lies in the image, where all ways do the same sum."""
    inner = [_is_inner(first, patches.size, fixed.image.shape) for first in patches.first]
    return np.where(np.array(inner)[:, None], rho, np.nan)


def _is_inner(first: np.ndarray, size: np.ndarray, shape: tuple[int, int]) -> bool:
    return bool((first >= 1).all() and (first + size < shape).all())


def _median_seconds(way, fixed: ReadyFrame, moving: ReadyFrame, patches: PatchGrid, runs: int) -> float:
    spent = []
    for _ in range(runs):
        began = time.perf_counter()
        way(fixed, moving, patches)
        spent.append(time.perf_counter() - began)
    return float(np.median(spent))


def report_memory(path: Path, curves: DecorrelationCurves) -> None:
    """Print the peak resident memory of the command on a long sweep."""
    frames = len(load_sweep(path))
    with tempfile.TemporaryDirectory() as folder:
        curves_file = Path(folder) / "curves.h5"
        write_curves(curves_file, curves)
        modes = ["--drift", "orientation", "--drift", "pose"]
        command = ["reconstruct", str(path), "--curves", str(curves_file), "-o", folder, *modes]
        began = time.perf_counter()
        subprocess.run([sys.executable, "-m", "speckle3d.cli", *command], check=True, capture_output=True)
        spent = time.perf_counter() - began
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    print(f"{frames} frames ({path.stat().st_size / 1e9:.2f} GB): peak resident {peak:.2f} GB", end=" ")
    print(f"(target {TARGET_GB:g}{'!' if peak > TARGET_GB else ''}), the whole command in {spent:.0f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--memory", action="store_true", help="measure memory instead of speed")
    parser.add_argument("--cache", type=Path, default=DEFAULT)
    options = parser.parse_args()
    curves = curves_of(options.cache)
    path = simulated(SWEEP, options.cache)
    if options.memory:
        report_memory(to_and_fro(path, LONG_FRAMES, options.cache), curves)
        return
    report_pipeline(path, curves, options.runs)
    report_correlation(path, options.runs)


if __name__ == "__main__":
    main()
