"""How far halving and doubling each constant between the correlation table and the path moves lengths.

Run: ``python tests/benchmarks/bench_constants.py SWEEP... --curves CURVES``, with sweeps that have a truth.

Every module constant of `speckle3d.motion` that is a number or a tuple of numbers, and every numeric setting
of the stages there, is halved and doubled in turn; printed are those that move a length by more than
`--least` per cent, with the largest change and its sweep. Constants of kernels are compiled in and stay.
"""

import argparse
import importlib
import pkgutil
from contextlib import contextmanager
from pathlib import Path

import numpy as np

import speckle3d.motion
from speckle3d.config import Config
from speckle3d.core.errors import Speckle3DError
from speckle3d.io.curves import read_curves
from speckle3d.io.load import load_sweep
from speckle3d.pipeline import track

STAGES = ("planes", "trajectory")
NOT_OF_THE_PATH = ("diffraction", "lens", "phantom")
"""Modules of curves, which change no estimate."""


def module_constants():
    """Module, name and value of every numeric constant."""
    for info in pkgutil.iter_modules(speckle3d.motion.__path__):
        if info.name in NOT_OF_THE_PATH:
            continue
        module = importlib.import_module(f"speckle3d.motion.{info.name}")
        for name, value in vars(module).items():
            numbers = value if isinstance(value, tuple) else (value,)
            if name.isupper() and all(type(n) in (int, float) and n != 0 for n in numbers):
                yield module, name, value


def settings():
    """Stage, name and value of every numeric setting."""
    for stage in STAGES:
        for name, value in getattr(Config(), stage):
            if type(value) in (int, float) and value != 0:
                yield stage, name, value


@contextmanager
def changed(module, name, value, factor):
    """Multiply a constant where it stands and wherever it was imported."""
    new = type(value)(v * factor for v in value) if isinstance(value, tuple) else type(value)(value * factor)
    holders = [
        m
        for info in pkgutil.iter_modules(speckle3d.motion.__path__)
        if getattr(m := importlib.import_module(f"speckle3d.motion.{info.name}"), name, None) is value
    ]
    for holder in holders:
        setattr(holder, name, new)
    try:
        yield
    finally:
        for holder in holders:
            setattr(holder, name, value)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sweeps", nargs="+", type=Path)
    parser.add_argument("--curves", type=Path, required=True)
    parser.add_argument("--least", type=float, default=0.3, help="per cent below which nothing is said")
    chosen = parser.parse_args()
    sweeps, curves = [load_sweep(path) for path in chosen.sweeps], read_curves(chosen.curves)

    def lengths(config):
        """Travel along the normal of every sweep; NaN where it is refused."""
        every = []
        for sweep in sweeps:
            try:
                poses = track(sweep, curves, config).image
            except Speckle3DError:
                every.append(np.nan)
                continue
            centre = sweep.grid.centre_mm
            steps = (poses[:-1].inv() * poses[1:]).apply(centre)[:, 2] - centre[2]
            every.append(np.abs(np.cumsum(steps)).max())
        return np.array(every)

    usual, moved = lengths(Config()), {}
    for module, name, value in module_constants():
        for factor in (0.5, 2.0):
            with changed(module, name, value, factor):
                moved[f"{module.__name__.split('.')[-1]}.{name} x {factor:g}"] = lengths(Config())
    for stage, name, value in settings():
        for factor in (0.5, 2.0):
            try:
                config = Config.model_validate({stage: {name: type(value)(value * factor)}})
            except ValueError:
                continue
            moved[f"[{stage}] {name} x {factor:g}"] = lengths(config)
    print(f"{len(moved)} changes; those that move a length by {chosen.least:g} % or more, in per cent:")
    changes = {what: 100 * (length / usual - 1) for what, length in moved.items()}
    largest = {what: np.nan_to_num(np.abs(change), nan=np.inf).max() for what, change in changes.items()}
    for what in sorted(largest, key=lambda name: -largest[name]):
        if largest[what] >= chosen.least:
            print(f"  {what:50s}" + "".join(f"{value:+8.2f}" for value in changes[what]))


if __name__ == "__main__":
    main()
