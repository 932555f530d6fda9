"""Calibration with two simulated crossing threads: errors of the mounting, and over those claimed.

python tests/benchmarks/bench_threads.py [--scans 20] [--vectors 64] [--frames 90]
"""

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from bench_calibration_accuracy import recording_of
from options import parsed

from calibration.report import IMAGE_POSE
from speckle3d.calibrating.phantoms import found, solved
from speckle3d.calibrating.settings import WireSettings
from speckle3d.simulation.presets import SimulationSettings, simulate
from speckle3d.simulation.sensors import TRACKER_FROM_IMAGE

FIRST_SEED = 4001
"""Seeds that no test and no development used."""


def trial(seed, vectors, frames):
    """Errors of one scan: turns about the image's z, y, x and its place, rad and mm, and those claimed."""
    (simulated,) = simulate(SimulationSettings(preset="wires", seed=seed, vectors=vectors, frames=frames))
    recording = recording_of(simulated.sweep, simulated.sweep.tracker)
    solution = solved(recording, found(recording, WireSettings()), WireSettings()).solution
    step = TRACKER_FROM_IMAGE.inv() * solution.chain.sensor_from_image
    shift, turn = step.as_components()
    # Roll, yaw and tilt are about the image's z, y and x.
    error = np.array([*turn.as_rotvec(), *shift])
    return error, np.sqrt(np.diag(solution.image_covariance(IMAGE_POSE)))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=20)
    parser.add_argument("--vectors", type=int, default=64)
    parser.add_argument("--frames", type=int, default=90)
    given = parsed(parser, scans=1)
    seeds = range(FIRST_SEED, FIRST_SEED + given.scans)
    found = np.array([trial(seed, given.vectors, given.frames) for seed in seeds])
    errors, scores = found[:, 0], found[:, 0] / found[:, 1]
    print(f"{len(found)} scans of {given.frames} frames, seeds {seeds.start} to {seeds.stop - 1}")
    print("                          tilt    yaw   roll      x      y      z")
    size = np.sqrt(np.mean(errors**2, axis=0))
    size[:3] = np.rad2deg(size[:3])
    print("rms error, deg and mm  " + "".join(f"{one:7.2f}" for one in size))
    print("over those claimed     " + "".join(f"{one:7.2f}" for one in np.sqrt(np.mean(scores**2, axis=0))))
    within = [np.mean(np.abs(scores) < limit) for limit in (1.0, 1.96)]
    print(f"all: rms {np.sqrt(np.mean(scores**2)):.2f} claimed errors, largest {np.abs(scores).max():.1f}")
    print(f"within the 68 % interval {within[0]:.0%}, the 95 % interval {within[1]:.0%}")


if __name__ == "__main__":
    main()
