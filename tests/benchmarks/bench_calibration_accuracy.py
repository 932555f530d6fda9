"""Calibrations from simulated images against the truth and against what they claim: Housden 2008, Table 1.

Run: ``python tests/benchmarks/bench_calibration_accuracy.py [PHANTOM ...] [--scans N]``.

Each scan is another hand's, with the sensors of the simulator, their noise, drift and clock offset, over a
plane (a thin bar or a wall) or two crossing threads; or a package of a handheld with a sensor inside over a
plane: I/Q, packed, the sensor in bursts, of which the command sees nothing else.
"""

import tempfile
from pathlib import Path

import bench
import numpy as np
from commands import run_command
from handheld import PITCH_MM, write_handheld
from scipy.spatial.transform import RigidTransform

from calibration.detection.lines import detect_lines
from calibration.points import Recording
from speckle3d.calibrating.phantoms import detect_phantom, solve_phantom
from speckle3d.calibrating.settings import OrientationSettings, PlaneSettings, WireSettings
from speckle3d.core.errors import InsufficientDataError
from speckle3d.io.family.calibrations import read_calibration
from speckle3d.simulation.presets import SimulationSettings, simulate
from speckle3d.simulation.sensors import ORIENTATION_FROM_IMAGE, TRACKER_FROM_IMAGE
from speckle3d.study.images import GreyImages

FIRST_SEED = 3001
"""Seeds that no test and no development used."""


def simulate_sweep(preset, seed, frames, **settings):
    settings = SimulationSettings(preset=preset, seed=seed, frames=frames, **settings)
    return simulate(settings)[0].sweep


def recording_of(sweep, sensor):
    images = GreyImages(sweep, 60.0, clipped=False)
    return Recording(images, images.grid, sweep.frame_time_s, sensor.readings, sensor.time_offset_s)


def plane(reflector, seed, frames):
    """Name and calibration of both sensors by one scan of a plane."""
    sweep = simulate_sweep("plane", seed, frames, reflector=reflector, duration_s=frames / 5)
    orientation, tracker = (recording_of(sweep, sensor) for sensor in (sweep.orientation, sweep.tracker))
    lines = detect_lines(orientation.images, orientation.pixel_mm)
    for level in (False, True):
        outcome = solve_phantom(orientation, lines, OrientationSettings(level=level))
        yield f"orientation sensor, {'level' if level else 'any'} plane", outcome.calibration
    for fixed in (False, True):
        outcome = solve_phantom(tracker, lines, PlaneSettings(fixed_pixels=fixed, reflector="bar"))
        yield f"tracker, pixels {'held' if fixed else 'fitted'}", outcome.calibration


def wires(seed, frames):
    sweep = simulate_sweep("wires", seed, frames, vectors=64)
    recording = recording_of(sweep, sweep.tracker)
    yield (
        "tracker",
        solve_phantom(recording, detect_phantom(recording, WireSettings()), WireSettings()).calibration,
    )


def handheld(reflector, seed, frames):
    sweep = simulate_sweep("plane", seed, frames, reflector=reflector, vectors=48, signal="iq")
    with tempfile.TemporaryDirectory() as folder:
        settings, out = Path(folder) / "import.toml", Path(folder) / "mounting.h5"
        settings.write_text(f"vector_pitch_mm = {PITCH_MM}\nbandwidth_hz = [5e6, 10e6]\n", encoding="utf-8")
        package = write_handheld(Path(folder) / "bath.tar", sweep)
        run_command("calibrate", "orientation", package, "-o", out)
        yield "orientation sensor", read_calibration(out)


SCANS = {
    "bar": lambda *scan: plane("bar", *scan),
    "wall": lambda *scan: plane("wall", *scan),
    "wires": wires,
    "handheld": lambda *scan: handheld("wall", *scan),
    "handheld-bar": lambda *scan: handheld("bar", *scan),
}


def errors_of(calibration):
    """Errors about and along the image's x, y, z, degrees and mm, and those claimed; NaN without a place."""
    units = np.repeat([180.0 / np.pi, 1.0], 3)
    sigma = np.full(6, np.nan)
    variance = np.diag(calibration.covariance)[:6]
    sigma[: variance.size] = np.sqrt(variance)
    if calibration.sensor == "orientation":
        shift, turn = np.full(3, np.nan), ORIENTATION_FROM_IMAGE.inv() * calibration.rotation
    else:
        place = RigidTransform.from_components(calibration.translation_mm, calibration.rotation)
        shift, turn = (TRACKER_FROM_IMAGE.inv() * place).as_components()
    return np.array([[*turn.as_rotvec(), *shift], sigma]) * units


def report(name, errors):
    """Print bias, spread and claims of some scans."""
    finite = ~np.isnan(errors[0, 0])
    error, sigma = errors[:, 0, finite], errors[:, 1, finite]
    scores = error / sigma
    print(f"  {name}, {len(error)} scans: tilt, yaw, roll (and x, y, z)")
    rows = {
        "mean error, deg, mm": error.mean(axis=0),
        "standard deviation": error.std(axis=0, ddof=min(1, len(error) - 1)),
        "claimed": np.median(sigma, axis=0),
        "rms over claims": np.sqrt(np.mean(scores**2, axis=0)),
    }
    for row, values in rows.items():
        print(f"    {row:26}" + "".join(f"{value:8.3f}" for value in values))
    turns = np.linalg.norm(error[:, :3], axis=1)
    inside = [np.mean(np.abs(scores) < limit) for limit in (1.0, 1.96)]
    print(
        f"    turned by {np.median(turns):.2f} deg (median), {turns.max():.2f} at most; within the 68 % "
        f"interval {inside[0]:.0%}, the 95 % interval {inside[1]:.0%}, largest {np.abs(scores).max():.1f}"
    )


def main():
    parser = bench.parser_of(__doc__)
    parser.add_argument("phantoms", nargs="*", metavar="PHANTOM", help=f"of {', '.join(SCANS)}; or all")
    parser.add_argument("--scans", type=int, default=25)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    options = bench.parse_options(parser, phantoms=["bar", "handheld"], scans=1, frames=40)
    for phantom in options.phantoms or SCANS:
        print(
            f"{phantom}, {options.frames} frames (published, plane: sd of tilt, yaw, roll 1.50, 1.10, 0.08)"
        )
        errors_by_name = {}
        for seed in range(options.first_seed, options.first_seed + options.scans):
            try:
                for name, calibration in SCANS[phantom](seed, options.frames):
                    errors_by_name.setdefault(name, []).append(errors_of(calibration))
            except InsufficientDataError as error:
                print(f"  seed {seed} refused: {error}")
        for name, errors in errors_by_name.items():
            report(name, np.array(errors))


if __name__ == "__main__":
    main()
