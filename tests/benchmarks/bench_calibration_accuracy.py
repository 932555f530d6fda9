"""Precision and error of calibrations from simulated images, lines found in them: Housden 2008, Table 1.

Each trial is another scan of the plane by another hand, with the sensors of the simulator, their noise, drift
and clock offset; the first line of each block gives the published precision.

    python tests/benchmarks/bench_calibration_accuracy.py [--trials 25] [--frames 100]
"""

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from options import parsed

from calibration.detection.lines import detect_lines
from calibration.recording import Recording
from speckle3d.calibrating.phantoms import solved
from speckle3d.calibrating.settings import OrientationSettings, PlaneSettings
from speckle3d.core.errors import InsufficientDataError
from speckle3d.simulation.presets import SimulationSettings, simulate
from speckle3d.simulation.sensors import ORIENTATION_FROM_IMAGE, TRACKER_FROM_IMAGE
from speckle3d.study.images import GreyImages

FIRST_SEED = 3001
"""Seeds that no test and no development used."""


def recording_of(sweep, sensor):
    images = GreyImages(sweep, 60.0, clipped=False)
    size = np.array([images.grid.vector_pitch_mm, images.grid.sample_spacing_mm])
    return Recording(
        images,
        size,
        np.array([0.0, images.grid.first_sample_depth_mm]) / size,
        sweep.frame_time_s,
        sensor.readings,
        sensor.time_offset_s,
    )


def trial(seed, frames, reflector):
    """Errors of one scan: (tilt, yaw, roll) degrees of both sensors, centre mm of the tracker, or reasons."""
    simulated = simulate(
        SimulationSettings(
            preset="plane", seed=seed, frames=frames, reflector=reflector, duration_s=frames / 5
        )
    )[0]
    sweep = simulated.sweep
    recording = recording_of(sweep, sweep.orientation)
    seen = detect_lines(recording.images, recording.pixel_mm)
    found = {}
    for level in (False, True):
        outcome = solved(recording, seen, OrientationSettings(level=level))
        turn = ORIENTATION_FROM_IMAGE.inv() * outcome.calibration.rotation
        found[f"orientation sensor, {'level' if level else 'any'} plane"] = (
            np.rad2deg(turn.as_rotvec()),
            np.rad2deg(np.sqrt(np.diag(outcome.calibration.covariance))),
            None,
        )
    for fit in (True, False):
        outcome = solved(
            recording_of(sweep, sweep.tracker), seen, PlaneSettings(fixed_pixels=not fit, reflector="bar")
        )
        step = TRACKER_FROM_IMAGE.inv() * outcome.calibration.sensor_from_image
        centre = sweep.grid.centre_mm
        found[f"tracker, pixels {'fitted' if fit else 'held'}"] = (
            np.rad2deg(step.rotation.as_rotvec()),
            np.rad2deg(np.sqrt(np.diag(outcome.calibration.covariance)[:3])),
            step.apply(centre) - centre,
        )
    return found


def report(name, errors):
    angles = np.array([error[0] for error in errors])
    claims = np.array([error[1] for error in errors])
    sd = np.sqrt(np.mean((angles - angles.mean(axis=0)) ** 2, axis=0) * len(angles) / (len(angles) - 1))
    shown = ", ".join(f"{value:.3f}" for value in sd[::-1])
    bias = ", ".join(f"{value:+.3f}" for value in angles.mean(axis=0)[::-1])
    honest = ", ".join(f"{value:.2f}" for value in np.sqrt(np.mean((angles / claims) ** 2, axis=0))[::-1])
    print(f"  {name}: sd of roll, yaw, tilt {shown} degrees; mean error {bias}; error over claim {honest}")
    centres = [error[2] for error in errors if error[2] is not None]
    if centres:
        rms = np.sqrt(np.mean(np.sum(np.square(centres), axis=1)))
        mean = np.mean(centres, axis=0).round(2)
        print(f"    centre: mean error {mean} mm (x, y, z), RMS distance {rms:.2f} mm")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=25)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--reflector", choices=["bar", "wall"], action="append")
    options = parsed(parser, trials=2, frames=40, reflector=["bar"])
    for reflector in options.reflector or ["bar", "wall"]:
        print(
            f"{reflector}, {options.trials} scans of {options.frames} frames (published sd 0.08, 1.10, 1.50):"
        )
        collected = {}
        for number in range(options.trials):
            try:
                for name, error in trial(FIRST_SEED + number, options.frames, reflector).items():
                    collected.setdefault(name, []).append(error)
            except InsufficientDataError as error:
                print(f"  seed {FIRST_SEED + number} refused: {error}")
        for name, errors in collected.items():
            report(name, errors)


if __name__ == "__main__":
    main()
