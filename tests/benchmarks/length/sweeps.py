"""RF sweeps through the public command: lengths by crossing, fusion, with curves right and wrong.

A sweep is confident and wrong where its length is off by more than three of its own claimed deviations and
by more than twice the case's target.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from length.rows import Row
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


@dataclass(frozen=True)
class Outcome:
    """What the command found of one sweep in one mode.

    Attributes
    ----------
    length_percent, tilt_deg : float
        Largest error of a monotone part; NaN if the mode was refused.
    claimed_percent : float
        Standard deviation of the length that the mode claims.
    """

    seed: int
    mode: str
    length_percent: float
    tilt_deg: float
    claimed_percent: float
    refused: str = ""


@dataclass(frozen=True)
class Case:
    """A row of the table.

    Attributes
    ----------
    run : callable
        Of a seed and the folder of the sweeps, to the command's arguments.
    modes : sequence of str
        Reported, the first against the target.
    """

    name: str
    run: Callable[[int, Path], list[Any]]
    modes: Sequence[str]
    median_percent: float
    ninetieth_percent: float
    tilt_deg: float


def wrong_curves(cache: Path) -> Path:
    """Curves of a lens that focuses at 22 mm, in 0.8 dB/cm/MHz; the sweeps have 20 mm and 0.5."""
    path = cache / "wrong-curves.h5"
    if not path.is_file():
        write_curves(path, borrowed_curves(22.0, 0.8, cache))
    return path


def sheet_curves(cache: Path) -> Path:
    """Curves from a data sheet, by the public command."""
    path, sheet = cache / "sheet-curves.h5", cache / "sheet.toml"
    if not path.is_file():
        sheet.write_text(SHEET, encoding="utf-8")
        like = crossing_pair(1, 90.0, cache)[0]
        _command("calibrate", "curves", "--probe", sheet, "--like", like, "-o", path)
    return path


def saved_curves(seed: int, cache: Path) -> Path:
    """Curves that a crossing pair over other tissue corrected."""
    path = cache / f"saved-{seed}.h5"
    if not path.is_file():
        _command(*_crossed(seed, 90.0, wrong_curves(cache), cache, *_SENSORS), "--save-curves", path)
    return path


def without(path: Path, *sensors: str) -> Path:
    """A copy of a sweep without some of its sensors."""
    copy = path.with_name(f"{path.stem}-no-{'-'.join(sensors)}.h5")
    if not copy.is_file():
        part = copy.with_suffix(f".part{os.getpid()}")
        shutil.copy(path, part)
        with h5py.File(part, "a") as file:
            for sensor in sensors:
                del file[sensor]
        part.replace(copy)
    return copy


def _crossed(seed: int, angle_deg: float, curves: Path, cache: Path, *left_out: str) -> list[Any]:
    pair = crossing_pair(seed, angle_deg, cache)
    first, second = (without(path, *left_out) if left_out else path for path in pair)
    out = cache / "out" / f"crossed-{seed}-{angle_deg:g}-{curves.stem}-{'-'.join(left_out)}"
    call = ["reconstruct", first, "--crossing", second, "--curves", curves, "-o", out]
    return [*call, "--drift", "crossed", "--drift", "fused"]


def _single(seed: int, curves: Path, cache: Path, modes: Sequence[str], sweep: Path) -> list[Any]:
    out = cache / "out" / f"{sweep.stem}-{curves.stem}-{'-'.join(modes)}"
    return ["reconstruct", sweep, "--curves", curves, "-o", out, *(f"--drift={mode}" for mode in modes)]


_SENSORS = ("orientation", "tracker")

CASES = (
    Case(
        "crossing at 90 deg, tissue, curves right, no sensor",
        lambda seed, cache: _crossed(seed, 90.0, RIGHT, cache, *_SENSORS),
        ("crossed", "fused", "image"),
        1.0,
        2.0,
        0.5,
    ),
    Case(
        "crossing at 90 deg, tissue, curves right, orientation sensor",
        lambda seed, cache: _crossed(seed, 90.0, RIGHT, cache, "tracker"),
        ("crossed", "fused", "image"),
        1.0,
        2.0,
        0.2,
    ),
    Case(
        "crossing, curves of another focus (10 %) and attenuation (+0.3), no sensor",
        lambda seed, cache: _crossed(seed, 90.0, wrong_curves(cache), cache, *_SENSORS),
        ("crossed", "fused", "image"),
        1.5,
        3.0,
        0.5,
    ),
    Case(
        "crossing, curves from a data sheet with the focus wrong by 15 %, no sensor",
        lambda seed, cache: _crossed(seed, 90.0, sheet_curves(cache), cache, *_SENSORS),
        ("crossed", "fused", "image"),
        2.0,
        4.0,
        0.5,
    ),
    Case(
        "single sweep, curves corrected by a crossing pair over other tissue",
        lambda seed, cache: _single(
            seed,
            saved_curves(seed + 1 if seed % 2 else seed - 1, cache),
            cache,
            (),
            without(crossing_pair(seed, 90.0, cache)[0], *_SENSORS),
        ),
        ("image",),
        2.0,
        4.0,
        np.inf,
    ),
    Case(
        "crossing at 45 deg, curves right, no sensor",
        lambda seed, cache: _crossed(seed, 45.0, RIGHT, cache, *_SENSORS),
        ("crossed", "fused", "image"),
        2.0,
        4.0,
        0.7,
    ),
    Case(
        "fused with tracker, 3.6 to 6 mm: no worse than image and pose",
        lambda seed, cache: _single(seed, RIGHT, cache, ("pose", "orientation", "fused"), short(seed, cache)),
        ("fused", "image", "pose", "orientation"),
        np.inf,
        np.inf,
        0.1,
    ),
    Case(
        "fused with orientation sensor, 24 mm: length as image, angles as orientation",
        lambda seed, cache: _single(
            seed,
            RIGHT,
            cache,
            ("orientation", "fused"),
            without(crossing_pair(seed, 90.0, cache)[0], "tracker"),
        ),
        ("fused", "image", "orientation"),
        np.inf,
        np.inf,
        0.1,
    ),
)


def measure(seeds: Sequence[int], cache: Path, workers: int = 2, only: str = "") -> list[Row]:
    """Every case on every seed; sweeps that are not there yet are simulated."""
    rows = []
    # Made once, before workers ask for them together.
    wrong_curves(cache)
    sheet_curves(cache)
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        for case in [each for each in CASES if only in each.name]:
            number = CASES.index(case)
            found = list(pool.map(_outcomes, [number] * len(seeds), seeds, [cache] * len(seeds)))
            for mode in case.modes:
                mine = [each for some in found for each in some if each.mode == mode]
                rows.append(_row(case, mode, mine))
                print(
                    f"  {rows[-1].case}\n      {rows[-1].figures}\n      target: {rows[-1].target}",
                    flush=True,
                )
    return rows


def _outcomes(number: int, seed: int, cache: Path) -> list[Outcome]:
    case = CASES[number]
    arguments = case.run(seed, cache)
    summary = _command(*arguments, "--json")
    (held,) = json.loads(summary)["sweeps"]
    found = []
    for mode in case.modes:
        rows = [row for row in held["rows"] if row["mode"] == mode]
        claimed = 100 * held["claims"].get(mode, np.nan)
        if not rows:
            found.append(Outcome(seed, mode, np.nan, np.nan, claimed, held["left_out"].get(mode, "no row")))
            continue
        length = max((row["length_error_percent"] for row in rows), key=abs)
        tilt = max((row["tilt_error_deg"] for row in rows), key=abs)
        found.append(Outcome(seed, mode, length, tilt, claimed))
    return found


def _row(case: Case, mode: str, outcomes: Sequence[Outcome]) -> Row:
    told = [each for each in outcomes if not each.refused]
    refused = [f"{each.seed}: {each.refused}" for each in outcomes if each.refused]
    name = f"{case.name}: {mode}"
    if not told:
        return Row(name, f"all refused; {'; '.join(refused)}", "-")
    error = np.array([each.length_percent for each in told])
    claimed = np.array([each.claimed_percent for each in told])
    tilt = np.abs([each.tilt_deg for each in told])
    z = np.abs(error) / claimed
    wrong = int(((z > 3) & (np.abs(error) > 2 * min(case.median_percent, 3.0))).sum())
    figures = (
        f"length {np.median(np.abs(error)):.2f} % (90th {np.percentile(np.abs(error), 90):.2f}; "
        f"{', '.join(f'{e:+.1f}' for e in error)}), claimed {np.median(claimed):.1f} %, within 68 / 95 %: "
        f"{100 * np.mean(z < 1):.0f} / {100 * np.mean(z < 1.96):.0f}; tilt {np.median(tilt):.2f} deg; "
        f"{wrong} confident and wrong; {len(refused)} refused {'; '.join(refused)}"
    )
    length = f"{case.median_percent:g} %, 90th {case.ninetieth_percent:g} %; "
    goal = f"{length if np.isfinite(case.median_percent) else ''}tilt {case.tilt_deg:g} deg"
    return Row(name, figures, goal if mode == case.modes[0] else "-")


def _command(*arguments: Any) -> str:
    """Run the public command; what it prints. A mode left out is exit code 2, and no failure here."""
    call = [sys.executable, "-m", "speckle3d.cli", *map(str, arguments)]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 2) or (done.returncode == 2 and "results are in" not in done.stderr):
        raise RuntimeError(f"{' '.join(call)}: {done.stderr}")
    return done.stdout
