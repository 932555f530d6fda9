"""RF sweeps through the public command: lengths by crossing, fusion, with curves right and wrong.

A sweep is confident and wrong where its length is off by more than three of its own claimed deviations and
by more than 3 %.
"""

import json
import os
import shutil
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import h5py
import numpy as np

from length.scenes import borrowed_curves, crossing_pair, short
from speckle3d.io.curves import write_curves

RIGHT = Path(__file__).resolve().parents[3] / "data" / "curves.h5"
"""Of the simulator's default probe, over a phantom that attenuates as the tissue does."""
SHEET = """# A data sheet whose focal length is 15 % off: the sweeps' lens focuses at 20 mm.
elevation_aperture_mm = 5.0
elevation_focus_mm = 23.0
band_mhz = [5.0, 10.0]
attenuation_db_cm_mhz = 0.5
"""
SENSORS = ("orientation", "tracker")
CROSSED = ("crossed", "fused", "image")


def wrong_curves(cache):
    """Curves of a lens that focuses at 22 mm, in 0.8 dB/cm/MHz; the sweeps have 20 mm and 0.5."""
    path = cache / "wrong-curves.h5"
    if not path.is_file():
        write_curves(path, borrowed_curves(22.0, 0.8, cache))
    return path


def sheet_curves(cache):
    """Curves from a data sheet, by the public command."""
    path, sheet = cache / "sheet-curves.h5", cache / "sheet.toml"
    if not path.is_file():
        sheet.write_text(SHEET, encoding="utf-8")
        like = crossing_pair(1, 90.0, cache)[0]
        command("calibrate", "curves", "--probe", sheet, "--like", like, "-o", path)
    return path


def saved_curves(seed, cache):
    """Curves that a crossing pair over other tissue corrected."""
    path = cache / f"saved-{seed}.h5"
    if not path.is_file():
        command("reconstruct", *crossing(seed, 90.0, wrong_curves(cache), cache), "--save-curves", path)
    return path


def without_sensors(path):
    """A copy of a sweep without its sensors."""
    copy = path.with_name(f"{path.stem}-no-sensors.h5")
    if not copy.is_file():
        part = copy.with_suffix(f".part{os.getpid()}")
        shutil.copy(path, part)
        with h5py.File(part, "a") as file:
            for sensor in SENSORS:
                del file[sensor]
        part.replace(copy)
    return copy


def crossing(seed, angle_deg, curves, cache):
    """Arguments of the command for a pair."""
    first, second = map(without_sensors, crossing_pair(seed, angle_deg, cache))
    out = cache / "out" / f"crossed-{seed}-{angle_deg:g}-{curves.stem}"
    return [first, "--crossing", second, "--curves", curves, "-o", out, "--drift=crossed", "--drift=fused"]


def single(sweep, curves, cache, *modes):
    """Arguments of the command for one sweep."""
    out = cache / "out" / f"{sweep.stem}-{curves.stem}"
    return [sweep, "--curves", curves, "-o", out, *(f"--drift={mode}" for mode in modes)]


def corrected(seed, cache):
    """A single sweep with curves that a pair of another seed corrected."""
    curves = saved_curves(seed + 1 if seed % 2 else seed - 1, cache)
    return single(without_sensors(crossing_pair(seed, 90.0, cache)[0]), curves, cache)


def fused(seed, cache):
    """A short sweep with both sensors."""
    return single(short(seed, cache), RIGHT, cache, "pose", "orientation", "fused")


CASES = {
    "90 deg, curves right": (lambda seed, cache: crossing(seed, 90.0, RIGHT, cache), CROSSED),
    "curves of another focus (10 %) and attenuation (+0.3)": (
        lambda seed, cache: crossing(seed, 90.0, wrong_curves(cache), cache), CROSSED,
    ),
    "curves from a data sheet, focus 15 % off": (
        lambda seed, cache: crossing(seed, 90.0, sheet_curves(cache), cache), CROSSED,
    ),
    "single sweep, curves corrected by a crossing pair over other tissue": (corrected, ("image",)),
    "45 deg, curves right": (lambda seed, cache: crossing(seed, 45.0, RIGHT, cache), CROSSED),
    "fused with tracker, 3.6 to 6 mm": (fused, ("fused", "image", "pose", "orientation")),
}  # fmt: skip


def measure(seeds, cache, workers):
    """Name and figures of every case on every seed; sweeps that are not there yet are simulated."""
    # Made once, before workers ask for them together.
    wrong_curves(cache)
    sheet_curves(cache)
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        for name, (_, modes) in CASES.items():
            found = list(pool.map(outcomes, [name] * len(seeds), seeds, [cache] * len(seeds)))
            for number, mode in enumerate(modes):
                yield f"{name}: {mode}", figures([each[number] for each in found])


def outcomes(name, seed, cache):
    """Largest errors of a monotone part in each mode and the length's claim, % and degrees; or why not."""
    arguments, modes = CASES[name]
    (held,) = json.loads(command("reconstruct", *arguments(seed, cache), "--json"))["sweeps"]
    found = []
    for mode in modes:
        rows = [row for row in held["rows"] if row["mode"] == mode]
        if not rows:
            found.append(held["left_out"].get(mode, "no row"))
            continue
        length, tilt = (
            max((row[f"{kind}_error_{unit}"] for row in rows), key=abs)
            for kind, unit in (("length", "percent"), ("tilt", "deg"))
        )
        found.append((length, tilt, 100 * held["claims"].get(mode, np.nan)))
    return found


def figures(found):
    """Text of one mode's errors."""
    refused = [each for each in found if isinstance(each, str)]
    errors = np.abs([each for each in found if not isinstance(each, str)])
    if not len(errors):
        return f"all refused; {'; '.join(refused)}"
    error, tilt, claimed = errors.T
    wrong = int(((error > 3 * claimed) & (error > 3.0)).sum())
    return (
        f"length {np.median(error):.2f} % (90th {np.percentile(error, 90):.2f}), claimed "
        f"{np.median(claimed):.1f} %; tilt {np.median(tilt):.2f} deg; {wrong} confident and wrong; "
        f"{len(refused)} refused {'; '.join(refused)}"
    )


def command(*arguments):
    """Run the public command; what it prints. A mode left out is exit code 2, and no failure here."""
    call = [sys.executable, "-m", "speckle3d.cli", *map(str, arguments)]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 2) or (done.returncode == 2 and "results are in" not in done.stderr):
        raise RuntimeError(f"{' '.join(call)}: {done.stderr}")
    return done.stdout
