"""How far halving and doubling each constant between the correlation table and the path moves lengths.

Run: ``python tests/benchmarks/bench_constants.py [SWEEP...] [--curves CURVES]``, with sweeps that have a
truth.

Every module constant of `speckle3d.motion` that is a number is halved and doubled in turn; changes of
lengths are printed in per cent, the largest first. Constants of kernels are compiled in and stay.
"""

import pkgutil
from contextlib import ExitStack, contextmanager
from importlib import import_module
from itertools import islice
from pathlib import Path
from unittest.mock import patch

import bench
import numpy as np

import speckle3d.motion
from speckle3d.core.errors import Speckle3DError
from speckle3d.io.curves import read_curves
from speckle3d.io.load import load_sweep
from speckle3d.pipeline import track

NOT_OF_THE_PATH = ("diffraction", "lens", "phantom")
"""Modules of curves, which change no estimate."""
MODULES = [
    import_module(f"speckle3d.motion.{info.name}")
    for info in pkgutil.iter_modules(speckle3d.motion.__path__)
    if info.name not in NOT_OF_THE_PATH
]


@contextmanager
def constant(name, value):
    """Another value of a constant in all modules that have it."""
    with ExitStack() as stack:
        for module in MODULES:
            if hasattr(module, name):
                stack.enter_context(patch.object(module, name, value))
        yield


def changes():
    """Name and context of every change."""
    constants = {name: value for module in MODULES for name, value in vars(module).items() if name.isupper()}
    for name, value in constants.items():
        if type(value) in (int, float) and value != 0:
            for factor in (0.5, 2.0):
                yield f"{name} x {factor:g}", constant(name, type(value)(value * factor))


def travels(sweeps, curves):
    """Travel along the normal of every sweep; NaN where it is refused."""
    lengths = np.full(len(sweeps), np.nan)
    for k, sweep in enumerate(sweeps):
        try:
            poses = track(sweep, curves).image
        except Speckle3DError:
            continue
        centre = sweep.grid.centre_mm
        lengths[k] = np.abs(np.cumsum((poses[:-1].inv() * poses[1:]).apply(centre)[:, 2] - centre[2])).max()
    return lengths


def main():
    parser = bench.parser_of(__doc__)
    parser.add_argument("sweeps", nargs="*", type=Path, default=[bench.DATA / "phantom.h5"])
    parser.add_argument("--curves", type=Path, default=bench.DATA / "curves.h5")
    parser.add_argument("--frames", type=int, default=100000, help="of each sweep, at most")
    parser.add_argument("--most", type=int, default=1000, help="changes, at most")
    options = bench.parse_options(parser, frames=12, most=4)
    sweeps = [load_sweep(path) for path in options.sweeps]
    sweeps = [sweep.part(0, min(options.frames, len(sweep))) for sweep in sweeps]
    curves, rows = read_curves(options.curves), {}
    usual = travels(sweeps, curves)
    for name, context in islice(changes(), options.most):
        with context:
            rows[name] = 100 * (travels(sweeps, curves) / usual - 1)
    for name in sorted(rows, key=lambda name: -np.nan_to_num(np.abs(rows[name]), nan=np.inf).max()):
        print(f"  {name:50s}" + "".join(f"{value:+8.2f}" for value in rows[name]))


if __name__ == "__main__":
    main()
