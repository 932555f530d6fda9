"""Calibration from two crossing sweeps: the published study of random starts.

Run: ``python tests/benchmarks/bench_image_calibration.py [--starts 183] [--seed 601]``.

The pair of sweeps is simulated tissue (minutes, kept in the cache); each start has every parameter off at
random within 20 mm and 20 degrees.
"""

import bench
import numpy as np
from cache import sweep_file
from crossing_scenes import displace

from calibration.images.similarity import prepare
from calibration.images.solver import calibrate_images
from calibration.points import Recording
from calibration.settings import ImageFit
from speckle3d.core.errors import InsufficientDataError
from speckle3d.io.load import load_sweep
from speckle3d.simulation.presets import SimulationSettings
from speckle3d.simulation.sensors import TRACKER_FROM_IMAGE
from speckle3d.study.images import GreyImages

AGREEMENT_MM = 0.5
TRUTH = TRACKER_FROM_IMAGE


def read_recording(path):
    """A sweep as B-mode with its tracker's readings, which do not say how the image sits."""
    sweep = load_sweep(path)
    images = GreyImages(sweep, 60.0, clipped=False)
    frames = np.stack([images[k] for k in range(len(sweep))])
    tracker = sweep.tracker
    return Recording(frames, images.grid, sweep.frame_time_s, tracker.readings, tracker.time_offset_s)


def prepare_pair(seed, frames=160):
    """A simulated pair of sweeps, read."""
    settings = SimulationSettings(
        preset="crossed",
        seed=seed,
        fan_deg=50.0,
        length_mm=20.0,
        frames=frames,
        vectors=96,
        samples=3000,
        uncalibrated=True,
    )
    return prepare(*(read_recording(sweep_file(settings, number=number)) for number in (0, 1)))


def study(crossing, starts):
    """Errors of the image's centre along its axes, by start."""
    rng, rows = np.random.default_rng(183), []
    for _ in range(starts):
        try:
            estimate = calibrate_images(crossing, displace(TRUTH, rng), ImageFit()).sensor_from_image
            error = (TRUTH.inv() * estimate).apply(crossing.centre_mm) - crossing.centre_mm
        except InsufficientDataError:
            error = np.full(3, np.inf)
        rows.append(error)
    return np.array(rows)


def main():
    parser = bench.parser_of(__doc__)
    parser.add_argument("--starts", type=int, default=183)
    parser.add_argument("--seed", type=int, default=601)
    parser.add_argument("--frames", type=int, default=160)
    options = bench.parse_options(parser, starts=1, frames=16)
    errors = study(prepare_pair(options.seed, options.frames), options.starts)
    middle = np.median(errors, axis=0)
    with np.errstate(invalid="ignore"):
        agreement = np.mean(np.linalg.norm(errors - middle, axis=1) < AGREEMENT_MM)
    print(
        f"pair {options.seed}, {len(errors)} starts: {agreement:.1%} reach the same answer; centre off by "
        f"{np.median(np.linalg.norm(errors, axis=1)):.3f} mm median, along x, y, z by {middle.round(3)}"
    )


if __name__ == "__main__":
    main()
