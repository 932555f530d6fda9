"""Calibration from two crossing sweeps: the published study of random starts.

Run: ``python tests/benchmarks/bench_image_calibration.py [--starts 183] [--seeds 601]``.

Each pair of sweeps is simulated tissue (minutes, kept in the cache); each start has every parameter off at
random within 20 mm and 20 degrees. With several seeds each pair is studied in turn.
"""

import argparse
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from cache import simulated_pair
from crossing_scenes import displaced
from options import parsed

from calibration.images.similarity import prepare
from calibration.images.solver import calibrate_from_sweeps
from calibration.images.stacks import TrackedImages
from calibration.settings import ImageFit
from speckle3d.core.errors import InsufficientDataError
from speckle3d.io.load import load_sweep
from speckle3d.simulation.presets import SimulationSettings
from speckle3d.simulation.sensors import TRACKER_FROM_IMAGE
from speckle3d.study.images import GreyImages

SAME_MM = 0.5
TRUTH = TRACKER_FROM_IMAGE


def opened(path):
    """A sweep as B-mode with its tracker's readings, which do not say how the image sits."""
    sweep = load_sweep(path)
    images = GreyImages(sweep, 60.0, clipped=False)
    held = np.stack([images[k] for k in range(len(sweep))])
    tracker = sweep.tracker
    return TrackedImages(held, images.grid, sweep.frame_time_s, tracker.readings, tracker.time_offset_s)


def prepared(seed):
    """A simulated pair of sweeps, read."""
    settings = SimulationSettings(
        preset="crossed",
        seed=seed,
        fan_deg=50.0,
        length_mm=20.0,
        frames=160,
        vectors=96,
        samples=3000,
        uncalibrated=True,
    )
    return prepare(*map(opened, simulated_pair(settings)))


def study(crossing, starts):
    """Errors of the image's centre along its axes, wall clock and processor time, by start."""
    rng = np.random.default_rng(183)
    rows = []
    for number in range(starts):
        start, wall, cpu = displaced(TRUTH, rng), time.perf_counter(), time.process_time()
        try:
            found = calibrate_from_sweeps(crossing, start, ImageFit()).sensor_from_image
            error = (TRUTH.inv() * found).apply(crossing.centre_mm) - crossing.centre_mm
        except InsufficientDataError:
            error = np.full(3, np.inf)
        rows.append([*error, time.perf_counter() - wall, time.process_time() - cpu])
        if sys.stderr.isatty():
            sys.stderr.write(f"\r{number + 1} of {starts}")
    return np.array(rows)


def described(rows):
    errors, distance = rows[:, :3], np.linalg.norm(rows[:, :3], axis=1)
    with np.errstate(invalid="ignore"):
        same = (np.linalg.norm(errors - np.median(errors, axis=0), axis=1) < SAME_MM).mean()
    axes = ", ".join(f"{value:+.3f}" for value in np.median(errors, axis=0))
    wall, cpu = np.median(rows[:, 3:], axis=0)
    return (
        f"{len(rows)} starts: {100 * same:.1f} % reach the same answer; centre off by "
        f"{np.median(distance):.3f} mm median, along x, y, z by {axes}; {wall:.1f} s each "
        f"({cpu:.1f} s of processor)\n"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=183)
    parser.add_argument("--seeds", type=int, nargs="+", default=[601])
    given = parsed(parser, starts=2)
    for seed in given.seeds:
        crossing = prepared(seed)
        study(crossing, 1)  # compiled, and images blurred, before any clock runs
        sys.stdout.write(f"pair {seed}\n{described(study(crossing, given.starts))}")


if __name__ == "__main__":
    main()
