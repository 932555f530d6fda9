"""Lengths of a sweep as RF, as I/Q and as 8-bit B-mode images, each with its own curves, through the command.

Run: ``python tests/benchmarks/bench_signals.py [--seeds 6] [--first-seed 1] [--workers 2]``. Simulated sweeps
of 12 mm, over a phantom and over tissue, are stored in each way that scanners do. I/Q are pairs of 16
bits, demodulated at the band's centre and off it; they use the curves of RF. Images are log-compressed;
full white is 20 dB over the mean of speckle; their curves are of a phantom seen by the same scanner. Sweeps
are simulated once (half an hour on two cores) and kept.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from cache import DEFAULT, key_of, simulated

from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.io.load import load_sweep
from speckle3d.io.sweep_writer import write_sweep
from speckle3d.simulation.receiver import received_as_bmode, received_as_iq
from speckle3d.simulation.settings import SimulationSettings

VECTORS, LENGTH_MM = 64, 12.0
PRESETS = ("phantom", "tissue")
CURVES = SimulationSettings(preset="stepped", vectors=VECTORS, blocks=6, seed=77)


@dataclass(frozen=True)
class Kind:
    """How a scanner stores its echoes.

    Attributes
    ----------
    make : callable
        Of an RF sweep.
    curves_of : str
        The kind whose phantom the curves are measured on.
    """

    name: str
    make: Callable[[Sweep], Sweep]
    curves_of: str


def taken_for(sweep: Sweep, made_db: float, told_db: float) -> Sweep:
    """Images of one dynamic range whose user tells another."""
    return replace(received_as_bmode(sweep, made_db), signal=BModeSettings(told_db))


KINDS = (
    Kind("RF", lambda sweep: sweep, "RF"),
    Kind("I/Q at 7.5 MHz", received_as_iq, "RF"),
    Kind("I/Q at 6.5 MHz", partial(received_as_iq, frequency_hz=6.5e6), "RF"),
    Kind("I/Q at 7.5 MHz, 6.7 MHz of it", partial(received_as_iq, frequency_hz=7.5e6, decimation=10), "RF"),
    Kind("B-mode 60 dB", partial(received_as_bmode, dynamic_range_db=60.0), "B-mode 60 dB"),
    Kind("B-mode 40 dB", partial(received_as_bmode, dynamic_range_db=40.0), "B-mode 40 dB"),
    Kind("B-mode 60 dB, told 70", partial(taken_for, made_db=60.0, told_db=70.0), "B-mode 60 dB, told 70"),
)


def stored(settings: SimulationSettings, kind: Kind, folder: Path) -> Path:
    """The sweep of some settings as a scanner stores it."""
    rf = simulated(settings, folder)
    path = folder / f"{rf.stem}-{key_of(kind.name)}.h5"
    if not path.is_file():
        write_sweep(path, kind.make(load_sweep(rf)))
    return path


def curves_of(name: str, folder: Path) -> Path:
    """Curves of a phantom that is stored in the same way."""
    kind = next(each for each in KINDS if each.name == name)
    source = stored(CURVES, kind, folder)
    path = source.with_name(f"curves-{source.name}")
    if not path.is_file():
        run("calibrate", "curves", source, "-o", path)
    return path


def run(*words: object) -> str:
    """Output of the command."""
    command = [sys.executable, "-m", "speckle3d.cli", *map(str, words)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def measure(preset: str, seed: int, folder: Path) -> dict[str, tuple[float, float]]:
    """Length found and true of one sweep, by kind, mm."""
    settings = SimulationSettings(preset=preset, seed=seed, vectors=VECTORS, length_mm=LENGTH_MM)
    found = {}
    for kind in KINDS:
        path = stored(settings, kind, folder)
        out = folder / f"out-{path.stem}"
        text = run("reconstruct", path, "-o", out, "--curves", curves_of(kind.curves_of, folder),
                   "--reference", "truth", "--json")  # fmt: skip
        (row,) = (each for each in json.loads(text)["sweeps"][0]["rows"] if each["mode"] == "image")
        found[kind.name] = row["estimate_mm"], row["reference_mm"]
    return found


def report(preset: str, lengths: list[dict[str, tuple[float, float]]]) -> None:
    """Print median and 90th percentile of the errors, and what I/Q differ from RF."""
    print(f"\n{preset}: {len(lengths)} sweeps of {LENGTH_MM:g} mm, {VECTORS} vectors")
    print(f"  {'stored as':32}{'median':>8}{'90th':>8}{'mean, signed':>14}{'most from RF':>14}")
    of_rf = np.array([each[KINDS[0].name][0] for each in lengths])
    for kind in KINDS:
        found, true = np.array([each[kind.name] for each in lengths]).T
        error = 100 * (found / true - 1)
        off = np.abs(100 * (found / of_rf - 1)).max()
        far = np.percentile(np.abs(error), 90)
        median = np.median(np.abs(error))
        print(f"  {kind.name:32}{median:6.2f} %{far:6.2f} %{error.mean():12.2f} %{off:12.3f} %")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=6, help="how many")
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=DEFAULT)
    options = parser.parse_args()
    began = time.perf_counter()
    for name in dict.fromkeys(kind.curves_of for kind in KINDS):
        curves_of(name, options.cache)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        jobs = {
            preset: [pool.submit(measure, preset, seed, options.cache) for seed in seeds]
            for preset in PRESETS
        }
        for preset, results in jobs.items():
            report(preset, [job.result() for job in results])
    print(f"\nseeds {seeds[0]} to {seeds[-1]}, curves {CURVES.seed}; {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
