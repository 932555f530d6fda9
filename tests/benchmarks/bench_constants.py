"""How far halving and doubling each constant between the correlation table and the poses moves results.

Run: ``python tests/benchmarks/bench_constants.py [SWEEP...] [--curves CURVES]``; some seconds for each of the
sweeps and constants.

Every module constant of `speckle3d.motion` and `speckle3d.correction` that is a number is halved and doubled
in turn, those of crossing sweeps and of curves apart. Sweeps are matched once. Printed are the largest change
of a length, per cent, and of its claim, a ratio, of any sweep in the modes `image` and `fused`, and what is
found otherwise; the largest first. Constants of kernels are compiled in and stay.
"""

from contextlib import ExitStack, contextmanager
from importlib import import_module
from itertools import islice
from pathlib import Path
from unittest.mock import patch

import bench
import numpy as np

from speckle3d import pipeline
from speckle3d.correction.claims import length_sigma
from speckle3d.corrections import correct
from speckle3d.io.family.curves import read_curves
from speckle3d.io.load import load_sweep
from speckle3d.matching.frames import match_sweep

STAGES = {
    "motion": "attenuation coherence estimate planes sensors signs tissue trajectory uncertainty",
    "correction": "claims fused image_path sensor_readings",
}
MODULES = [
    import_module(f"speckle3d.{room}.{stage}") for room, stages in STAGES.items() for stage in stages.split()
]


@contextmanager
def constant(name, value, other):
    """Another value of a constant in all modules that have it."""
    with ExitStack() as stack:
        for module in MODULES:
            if vars(module).get(name) == value:
                stack.enter_context(patch.object(module, name, other))
        yield


def changes():
    """Name and context of every change."""
    constants = {item for module in MODULES for item in vars(module).items() if type(item[1]) in (int, float)}
    for name, value in sorted(constants):
        if name.isupper() and value:
            for factor in (0.5, 2.0):
                yield f"{name} = {value:g} x {factor:g}", constant(name, value, type(value)(value * factor))


def results(sweeps, curves):
    """Length and its relative claim by mode, shape (sweeps, 2, 2), NaN where refused; and what is found."""
    values, doubts = np.full((len(sweeps), 2, 2), np.nan), set()
    for k, sweep in enumerate(sweeps):
        try:
            tracked = pipeline.track(sweep, curves)
            fused = correct(tracked, sweep, "fused")["fused"]
        except Exception as error:  # noqa: BLE001 (what a changed constant breaks is its result)
            doubts.add(str(error))
            continue
        doubts |= {f"{doubt.about}: {doubt.suspect}" for doubt in tracked.doubts}
        for row, (poses, covariance) in enumerate(
            ((tracked.image, tracked.covariance), (fused.poses, fused.covariance))
        ):
            centre = sweep.grid.centre_mm
            z_mm = (poses[0].inv() * poses).apply(centre)[:, 2]
            values[k, row] = np.abs(z_mm).max(), length_sigma(poses, covariance, centre)
    return values, doubts


def main():
    parser = bench.parser_of(__doc__)
    parser.add_argument("sweeps", nargs="*", type=Path, default=[bench.DATA / "phantom.h5"])
    parser.add_argument("--curves", type=Path, default=bench.DATA / "curves.h5")
    parser.add_argument("--frames", type=int, default=100000, help="of each sweep, at most")
    parser.add_argument("--most", type=int, default=1000, help="changes, at most")
    options = bench.parse_options(parser, frames=12, most=4)
    sweeps = [load_sweep(path) for path in options.sweeps]
    sweeps = [sweep.part(0, min(options.frames, len(sweep))) for sweep in sweeps]
    curves, tables, rows = read_curves(options.curves), {}, []

    def match_once(sweep, *rest):
        if id(sweep) not in tables:
            tables[id(sweep)] = match_sweep(sweep, *rest)
        return tables[id(sweep)]

    with patch.object(pipeline, "match_sweep", match_once):
        usual, usual_doubts = results(sweeps, curves)
        for label, context in islice(changes(), options.most):
            with context:
                values, doubts = results(sweeps, curves)
            length, claim = np.nanmax(np.abs(np.log(values / usual)), axis=(0, 1), initial=0.0)
            rows.append((length, np.exp(claim), label, " ".join(sorted(doubts ^ usual_doubts))))
    for length, claim, label, others in sorted(rows, reverse=True):
        print(f"  {label:50s}{100 * length:8.2f} %{claim:8.2f}  {others}")


if __name__ == "__main__":
    main()
