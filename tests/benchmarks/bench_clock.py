"""The delay of a tracker from images of simulated tissue, passed forward and back at 10 mm/s.

Run: ``python tests/benchmarks/bench_clock.py`` (sweeps are simulated once and kept in the cache).
"""

import os
import sys
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from cache import simulated

from calibration.clock.images import delay_from_images
from calibration.images.stacks import TrackedImages
from speckle3d.io.load import load_sweep
from speckle3d.simulation.presets import SimulationSettings
from speckle3d.study.images import GreyImages

SEEDS = (41, 42, 43)


def main():
    for seed in SEEDS:
        settings = SimulationSettings(preset="reversal", seed=seed, vectors=32, samples=1909, frames=100)
        sweep = load_sweep(simulated(settings))
        images, tracker = GreyImages(sweep, 60.0, clipped=False), sweep.tracker
        began = time.perf_counter()
        tracked = TrackedImages(images, images.grid, sweep.frame_time_s, tracker.readings)
        found = delay_from_images(tracked, tracker.sensor_from_image)
        sys.stdout.write(
            f"seed {seed}: {1e3 * (found.seconds - tracker.time_offset_s):+.1f} ms off, "
            f"claimed {1e3 * found.standard_error_s:.1f} ms, {time.perf_counter() - began:.1f} s\n"
        )


if __name__ == "__main__":
    main()
