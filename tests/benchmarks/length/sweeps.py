"""RF sweeps through the public command: lengths by crossing, fusion, with curves right and wrong.

A sweep is confident and wrong where its length is off by more than three of its own claimed deviations and
by more than 3 %.
"""

import json
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import bench
import numpy as np
from cache import ensure_file, sweep_file

from speckle3d.io.family.curves import write_curves
from speckle3d.io.load import load_sweep
from speckle3d.phantom_curves import calibrate_curves
from speckle3d.sheet_curves import ProbeSheet, data_sheet_curves
from speckle3d.simulation.beam import Probe, tabulate_beam
from speckle3d.simulation.presets import simulate
from speckle3d.simulation.settings import SimulationSettings

RIGHT = bench.DATA / "curves.h5"
"""Of the simulator's default probe, over a phantom that attenuates as the tissue does."""
SHEET = ProbeSheet(elevation_aperture_mm=5.0, elevation_focus_mm=23.0, band_mhz=(5.0, 10.0))
"""Its focal length is 15 % off: the sweeps' lens focuses at 20 mm."""
WRONG = {"elevation_focus_mm": 22.0}, 0.8
"""Lens and attenuation in dB/cm/MHz of a phantom; the sweeps have 20 mm and 0.5."""
MODES = ("crossed", "fused", "image")
_PAIR = {"preset": "crossed", "vectors": 96, "samples": 2600, "length_mm": 24.0, "frames": 150}
_STEPS = {"preset": "stepped", "vectors": 48, "steps": 41, "step_mm": 0.05, "blocks": 3}


def crossing_pair(seed, angle_deg, cache):
    """Two tissue sweeps of 24 mm that cross in their middle; the first is the same at all angles."""
    settings = [SimulationSettings(seed=seed, crossing_deg=a, **_PAIR) for a in (90.0, angle_deg)]
    return [without_sensors(sweep_file(s, cache, number)) for number, s in enumerate(settings)]


def without_sensors(path):
    """A copy of a sweep without its sensors."""
    copy = path.with_name(f"{path.stem}-no-sensors.h5")
    return ensure_file(copy, lambda: replace(load_sweep(path), orientation=None, tracker=None))


def wrong_curves(cache):
    """Curves of another lens and attenuation."""
    path, (lens, attenuation) = cache / "wrong-curves.h5", WRONG
    if not path.is_file():
        beam = tabulate_beam(Probe(**lens), attenuation_db_cm_mhz=attenuation)
        sweeps = []
        for seed in (11, 12):
            sweep = simulate(SimulationSettings(seed=seed, **_STEPS))[0].sweep
            medium = replace(sweep.frames.medium, attenuation_db_cm_mhz=attenuation)
            sweeps.append(replace(sweep, frames=replace(sweep.frames, medium=medium, beam=beam)))
        write_curves(path, calibrate_curves(sweeps))
    return path


def sheet_curves(cache):
    """Curves from a data sheet."""
    path = cache / "sheet-curves.h5"
    if not path.is_file():
        write_curves(path, data_sheet_curves(SHEET, load_sweep(crossing_pair(1, 90.0, cache)[0])))
    return path


def crossing(seed, angle_deg, curves, cache):
    """Arguments of the command for a pair."""
    first, second = crossing_pair(seed, angle_deg, cache)
    out = cache / "out" / f"crossed-{seed}-{angle_deg:g}-{curves.stem}"
    return [first, "--crossing", second, "--curves", curves, "-o", out, "--drift=crossed", "--drift=fused"]


def single(seed, cache):
    """A single sweep with wrong curves that a crossing pair of another seed, over other tissue, corrected."""
    curves, pair = cache / f"saved-{seed}.h5", seed + 1 if seed % 2 else seed - 1
    if not curves.is_file():
        command("reconstruct", *crossing(pair, 90.0, wrong_curves(cache), cache), "--save-curves", curves)
    return [crossing_pair(seed, 90.0, cache)[0], "--curves", curves, "-o", cache / "out" / f"single-{seed}"]


CASES = {
    "90 deg, curves right": (lambda seed, cache: crossing(seed, 90.0, RIGHT, cache), MODES),
    "curves of another focus (10 %) and attenuation (+0.3)": (
        lambda seed, cache: crossing(seed, 90.0, wrong_curves(cache), cache), MODES,
    ),
    "curves from a data sheet, focus 15 % off": (
        lambda seed, cache: crossing(seed, 90.0, sheet_curves(cache), cache), MODES,
    ),
    "single sweep, curves corrected by a crossing pair over other tissue": (single, ("image",)),
    "45 deg, curves right": (lambda seed, cache: crossing(seed, 45.0, RIGHT, cache), MODES),
}  # fmt: skip


def measure(seeds, cache, workers):
    """Name and figures of every case on every seed; sweeps that are not there yet are simulated."""
    # Made once, before workers ask for them together.
    wrong_curves(cache)
    sheet_curves(cache)
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        for name, (_, modes) in CASES.items():
            results = list(pool.map(outcomes, [name] * len(seeds), seeds, [cache] * len(seeds)))
            for number, mode in enumerate(modes):
                yield f"{name}: {mode}", figures([row[number] for row in results])


def outcomes(name, seed, cache):
    """Largest errors of a monotone part in each mode and the length's claim, % and degrees; or why not."""
    arguments, modes = CASES[name]
    (result,) = json.loads(command("reconstruct", *arguments(seed, cache), "--json"))["sweeps"]
    errors = []
    for mode in modes:
        rows = [row for row in result["rows"] if row["mode"] == mode]
        if not rows:
            errors.append(result["left_out"].get(mode, "no row"))
            continue
        length, tilt = (
            max((row[column] for row in rows), key=abs)
            for column in ("length_error_percent", "tilt_error_deg")
        )
        errors.append((length, tilt, 100 * result["claims"].get(mode, np.nan)))
    return errors


def figures(rows):
    """Text of errors: tuples of length, tilt and claim, %, degrees and %, or words of a refusal."""
    errors = np.abs([row for row in rows if not isinstance(row, str)])
    text = f"{len(rows) - len(errors)} of {len(rows)} refused"
    if not len(errors):
        return text
    error, tilt, sigma = errors.T
    inside = [np.mean(error < limit * sigma) for limit in (1.0, 1.96)]
    wrong = int(((error > 3 * sigma) & (error > 3.0)).sum())
    return (
        f"{text}; length {np.median(error):.2f} % (90th {np.percentile(error, 90):.2f}), claimed "
        f"{np.median(sigma):.2f} %, 68 %: {inside[0]:.0%}, 95 %: {inside[1]:.0%}; {wrong} confident and "
        f"wrong; tilt {np.median(tilt):.2f} deg"
    )


def command(*arguments):
    """Run the public command; what it prints. A mode left out is exit code 2, and no failure here."""
    call = [sys.executable, "-m", "speckle3d.cli", *map(str, arguments)]
    run = subprocess.run(call, capture_output=True, text=True, check=False)
    if run.returncode not in (0, 2) or (run.returncode == 2 and "results are in" not in run.stderr):
        raise RuntimeError(f"{' '.join(call)}: {run.stderr}")
    return run.stdout
