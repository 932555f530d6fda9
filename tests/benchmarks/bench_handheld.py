"""Mountings found from packages of a handheld with a sensor inside, and lengths beside the sweep's own.

    python tests/benchmarks/bench_handheld.py [--seeds 12] [--first-seed 1] [--reflector wall]

The scanner's packages are made of simulated scans of a bath's floor: I/Q, packed, the sensor in bursts. The
command `speckle3d calibrate orientation` sees nothing but the package.
"""

import argparse
import statistics
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from commands import run_command
from handheld import PITCH_MM, write_handheld
from options import parsed
from scipy.spatial.transform import Rotation

from speckle3d.io.calibrations import read_calibration
from speckle3d.simulation.presets import SimulationSettings, simulate

GIVEN = f"vector_pitch_mm = {PITCH_MM}\nbandwidth_hz = [5e6, 10e6]\n"


def mounting(folder, seed, reflector, frames):
    """Errors about the image's x, y, z and what is claimed of them, degrees."""
    settings = SimulationSettings(
        preset="plane",
        reflector=reflector,
        vectors=48,
        frames=frames,
        duration_s=30.0,
        seed=seed,
        signal="iq",
    )
    simulated = simulate(settings)[0]
    package = write_handheld(folder / f"bath-{seed}.tar", simulated.sweep)
    out = folder / f"mounting-{seed}.h5"
    run_command("calibrate", "orientation", package, "-o", out)
    found = read_calibration(out)
    true = Rotation.from_quat(
        simulated.description()["orientation_sensor_from_image_wxyz"], scalar_first=True
    )
    error = (true.inv() * found.rotation).as_rotvec(degrees=True)
    return error, np.rad2deg(np.sqrt(np.diag(found.covariance)))[:3]


def main():
    """Print a row for each seed and what they come to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--reflector", default="wall", choices=("wall", "bar"))
    parser.add_argument("--frames", type=int, default=110)
    given = parsed(parser, seeds=1, frames=60)
    ratios, sizes = [], []
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "import.toml").write_text(GIVEN, encoding="utf-8")
        for seed in range(given.first_seed, given.first_seed + given.seeds):
            error, claimed = mounting(Path(folder), seed, given.reflector, given.frames)
            ratios.extend(np.abs(error) / claimed)
            sizes.append(float(np.linalg.norm(error)))
            shown = ", ".join(f"{e:+.2f} ({c:.2f})" for e, c in zip(error, claimed, strict=True))
            print(f"seed {seed}: error (claimed) about x, y, z: {shown} deg", flush=True)
    one, two = (100 * np.mean(np.array(ratios) < k) for k in (1.0, 2.0))
    print(
        f"{given.reflector}, {given.seeds} scans: {statistics.median(sizes):.2f} deg in all, median; largest "
        f"{max(sizes):.2f}; {one:.0f} % within one claimed deviation, {two:.0f} % within two"
    )


if __name__ == "__main__":
    main()
