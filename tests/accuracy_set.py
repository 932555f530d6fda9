"""Small sweeps with known truth, one of each kind that users have, and how wrong every mode is on them.

What is measured stands in ``accuracy/table.toml``, which ``benchmarks/bench_accuracy_set.py`` writes anew.
"""

import os
import tomllib
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from crossing_tissue import GRID, PairCase, tissue_pair
from made_once import made_in
from sweep_examples import frames_of

from speckle3d.config import Config
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import OrientationSensor, Tracker
from speckle3d.correction.crossing.pair import solve_crossing
from speckle3d.corrections import correct
from speckle3d.io.family.curves import read_curves
from speckle3d.io.family.sweep_writer import write_sweep
from speckle3d.io.load import load_sweep
from speckle3d.phantom_curves import calibrate_curves
from speckle3d.scoring.lengths import compare_modes
from speckle3d.sheet_curves import ProbeSheet, data_sheet_curves
from speckle3d.simulation.beam import tabulate_beam
from speckle3d.simulation.presets import SimulationSettings, simulate
from speckle3d.simulation.receiver import received
from speckle3d.tracking import track

TABLE = Path(__file__).parent / "accuracy" / "table.toml"
SWEEPS_FOLDER = os.environ.get("SPECKLE3D_ACCURACY_SWEEPS")
"""For the simulated sweeps, of those who test again and again."""
INDEPENDENT = Path(__file__).resolve().parents[2] / "shared" / "independent"
SHORT_FRAMES = 28
"""Of 3.5 mm."""
CLUTTER, CLUTTER_MM = 0.3, 10.0
"""Amplitude at the skin, over a phantom's, of echoes that go with the probe; depth of 1/e of it."""
MOST_CLAIMS = 3.0
"""Error over claim that hardly any Gaussian error exceeds."""

SHEET = ProbeSheet(elevation_aperture_mm=5.0, elevation_focus_mm=20.0, band_mhz=(5.0, 10.0))
"""Of the simulator's probe."""


@dataclass(frozen=True)
class Errors:
    """Of one mode: signed, of the worst monotone part; claim, of the first part, or None without one."""

    length_percent: float
    tilt_deg: float
    claim_percent: float | None

    @property
    def over_claim(self):
        return abs(self.length_percent) / self.claim_percent


SIMULATED = {
    "tissue": {"preset": "tissue", "length_mm": 8.0, "seed": 4},
    "tissue-0.15": {"preset": "tissue", "length_mm": 5.0, "seed": 11},
    "tissue-0.7": {"preset": "tissue", "length_mm": 5.0, "seed": 21},
    "reversal": {"preset": "reversal", "length_mm": 6.0, "seed": 22, "vectors": 40},
    "rotation": {"preset": "rotation", "length_mm": 6.0, "seed": 6},
}
"""By file; a number is attenuation, dB/cm/MHz."""


def simulated(file):
    sweep = simulate(SimulationSettings(**{"vectors": 48, **SIMULATED[file]}))[0].sweep
    if "-" not in file:
        return sweep
    attenuation = float(file.split("-")[1])
    medium = replace(sweep.frames.medium, attenuation_db_cm_mhz=attenuation)
    beam = tabulate_beam(sweep.frames.beam.probe, attenuation_db_cm_mhz=attenuation)
    return replace(sweep, frames=replace(sweep.frames, medium=medium, beam=beam))


class Nothing:
    """A medium without echoes: what is left is electronic noise."""

    attenuation_db_cm_mhz = 0.4

    def scatterers(self, *_):
        return []


class Sum:
    """Sample by sample, of two sets of frames."""

    def __init__(self, frames, addend):
        self._frames, self._addend = frames, addend
        self.shape, self.dtype = frames.shape, frames.dtype

    def __getitem__(self, index):
        return self._frames[index] + self._addend[index]


def short(sweep):
    return sweep.part(0, SHORT_FRAMES)


def backwards(sweep):
    """The sweep's start as a probe that goes the other way would have recorded it."""
    sweep = short(sweep)
    span_s = sweep.frame_time_s[0] + sweep.frame_time_s[-1]

    def reversed_stream(kind, of, sensor):
        readings = sensor.readings
        stream = of(span_s - readings.time_s[::-1], readings.world_from_sensor[::-1])
        return kind(stream, sensor.sensor_from_image, -sensor.time_offset_s)

    return replace(
        sweep,
        frames=frames_of(sweep)[::-1],
        frame_time_s=span_s - sweep.frame_time_s[::-1],
        truth=sweep.truth[::-1],
        orientation=reversed_stream(OrientationSensor, TimedRotations, sweep.orientation),
        tracker=reversed_stream(Tracker, TimedPoses, sweep.tracker),
    )


def rounded_otherwise(sweep, seed):
    """One sample in ten thousand is one more or less, as another processor's arithmetic would have it."""
    frames = frames_of(sweep)
    draw = np.random.default_rng(seed).integers(20_000, size=frames.shape, dtype=np.uint16)
    return replace(sweep, frames=frames + (draw == 0).astype(frames.dtype) - (draw == 1).astype(frames.dtype))


def grey(sweep):
    return received(sweep, 60.0)


def without_tracker(sweep):
    return replace(sweep, tracker=None)


CASES = {
    "phantom": ("phantom",),
    "phantom, 3.5 mm": ("phantom", short),
    "phantom, backwards": ("phantom", backwards),
    "phantom, turned": ("rotation",),
    "phantom, data sheet": ("phantom", None, "sheet"),
    "phantom, data sheet of 17 mm": ("phantom", None, "wrong sheet"),
    "tissue": ("tissue",),
    "tissue, 3.5 mm": ("tissue", short),
    "tissue, 0.15 dB/cm/MHz": ("tissue-0.15",),
    "tissue, 0.7 dB/cm/MHz": ("tissue-0.7",),
    "tissue, there and back": ("reversal",),
    "tissue, there and back, no tracker": ("reversal", without_tracker),
    "tissue, B-mode": ("tissue", grey, "grey"),
    "tissue, noise at 20 dB": ("noise",),
    "tissue, clutter": ("clutter",),
    "tissue, data sheet": ("tissue", None, "sheet"),
    "crossing at 90 degrees": (),
    "independent tissue": ("tissue_mono", None, "independent"),
    "independent tissue, there and back": ("tissue_reverse", None, "independent"),
    "independent phantom, turned": ("phantom_rotate", None, "independent"),
}
"""File, what is done to its sweep, and curves. The crossing is `crossing_tissue`'s, of 24 mm."""

SLOW_FILES = (*SIMULATED.keys() - {"tissue"}, "noise", "clutter")
"""Simulated for slow tests alone; so are curves of images."""


def is_slow(case):
    return not CASES[case] or CASES[case][0] in SLOW_FILES or "grey" in CASES[case]


class AccuracySet:
    """Sweeps that are simulated to a folder, unless they are in it, and tracked when they are asked for.

    With a seed each is first `rounded_otherwise`.
    """

    def __init__(self, folder, data_folder, seed=None):
        self.folder, self.data_folder, self.seed, self.config = folder, data_folder, seed, Config()
        # Of the instance, so that a test's change to another leaves this one alone.
        self.errors, self.curves = cache(self._errors), cache(self._curves)

    def sweep(self, name):
        file, change = (*CASES[name], None)[:2]
        if name.startswith("independent"):
            sweep = load_sweep(INDEPENDENT / f"{file}.h5")
        else:
            sweep = self.load(file)
        sweep = sweep if self.seed is None else rounded_otherwise(sweep, self.seed)
        return sweep if change is None else change(sweep)

    def load(self, file):
        if file == "phantom":
            return load_sweep(self.data_folder / "phantom.h5")
        folder = made_in(
            self.folder, file, lambda folder: write_sweep(folder / "sweep.h5", self._simulated(file))
        )
        return load_sweep(folder / "sweep.h5")

    def _simulated(self, file):
        if file in SIMULATED:
            return simulated(file)
        tissue = self.load("tissue")
        if file == "noise":
            frames = replace(simulated("tissue").frames, medium=Nothing(), snr_db=20.0)
        else:
            depth = np.arange(tissue.grid.samples) * tissue.grid.sample_spacing_mm
            still = CLUTTER * np.exp(-depth / CLUTTER_MM) * self.load("phantom").frames[0]
            frames = np.broadcast_to(np.rint(still).astype(np.int16), tissue.frames.shape)
        return replace(tissue, frames=Sum(tissue.frames, frames))

    def _curves(self, kind, name):
        if kind == "sheet":
            return data_sheet_curves(SHEET, self.sweep(name), self.config)
        if kind == "wrong sheet":
            sheet = SHEET.model_copy(update={"elevation_focus_mm": 17.0})
            return data_sheet_curves(sheet, self.sweep(name), self.config)
        if kind == "grey":
            phantoms = [grey(self.sweep(name)) for name in ("phantom", "phantom, turned")]
            return calibrate_curves(phantoms, self.config)
        if kind == "independent":
            steps = sorted(INDEPENDENT.glob("phantom_steps_*.h5"))
            return calibrate_curves([load_sweep(path) for path in steps], self.config)
        return read_curves(self.data_folder / "curves.h5")

    def _errors(self, name):
        """Errors by mode."""
        if name.startswith("crossing"):
            pair = tissue_pair(PairCase(seed=2))
            first = solve_crossing(pair.first, pair.second).first
            return _score({"crossed": first}, pair.truth[0], GRID.centre_mm)
        sweep = self.sweep(name)
        kind = (*CASES[name], None, None)[2]
        curves = self.curves(kind, name if kind and "sheet" in kind else None)
        tracking = track(sweep, curves, self.config)
        modes = ["orientation", "fused", *(["pose"] if sweep.tracker else [])]
        modes = correct(tracking, sweep, modes, self.config)
        return _score({"image": tracking, **modes}, sweep.truth, sweep.grid.centre_mm)


def _score(modes, truth, centre_mm):
    poses = {mode: m.image if mode == "image" else m.poses for mode, m in modes.items()}
    rows = compare_modes(poses, truth, centre_mm, end_frames=1)
    errors = {}
    for mode, result in modes.items():
        parts = [row for row in rows if row.mode == mode]
        length = max((row.length_error_percent for row in parts), key=abs)
        tilt = max((row.tilt_error_deg for row in parts), key=abs)
        covariance, claim = getattr(result, "covariance", None), None
        if covariance is not None:
            sigma_mm = float(np.sqrt(covariance[parts[0].frames - 1, 2, 2]))
            claim = 100 * sigma_mm / abs(parts[0].reference_mm)
        errors[mode] = Errors(length, tilt, claim)
    return errors


def read_table():
    """Rows by ``case | mode``: what was measured, goals, and why they are not asserted yet."""
    return tomllib.loads(TABLE.read_text(encoding="utf-8"))
