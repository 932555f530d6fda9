"""The delay of a tracker from images of simulated tissue, passed forward and back at 10 mm/s.

Run: ``python tests/benchmarks/bench_clock.py [--scans 3]`` (sweeps are simulated once and kept in the
cache).
"""

import bench
from cache import sweep_file

from calibration.clock.images import delay_from_images
from calibration.points import Recording
from speckle3d.io.load import load_sweep
from speckle3d.simulation.presets import SimulationSettings
from speckle3d.study.images import GreyImages

FIRST_SEED = 41


def main():
    parser = bench.parser_of(__doc__)
    parser.add_argument("--scans", type=int, default=3)
    parser.add_argument("--frames", type=int, default=100)
    options = bench.parse_options(parser, scans=1, frames=60)
    for seed in range(FIRST_SEED, FIRST_SEED + options.scans):
        frames = {"frames": options.frames, "length_mm": options.frames / 5.0}
        settings = SimulationSettings(preset="reversal", seed=seed, vectors=32, samples=1909, **frames)
        sweep = load_sweep(sweep_file(settings))
        images, tracker = GreyImages(sweep, 60.0, clipped=False), sweep.tracker
        recording = Recording(images, images.grid, sweep.frame_time_s, tracker.readings)
        offset = delay_from_images(recording, tracker.sensor_from_image)
        off_ms, claim_ms = 1e3 * (offset.seconds - tracker.time_offset_s), 1e3 * offset.standard_error_s
        print(f"seed {seed}: {off_ms:+.1f} ms off, claimed {claim_ms:.1f} ms")


if __name__ == "__main__":
    main()
