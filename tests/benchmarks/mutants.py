"""Break the package on purpose, one way at a time, and see which test notices.

Run: ``python tests/benchmarks/mutants.py [NAME ...] [--keep FOLDER]``. A mutant changes what a function
takes or returns, in the process of the tests alone, so that no file is touched; then the tests that are to
notice are run. Ends with 1 if a mutant survives or no longer applies.
"""

import argparse
import importlib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path

import numpy as np
import pytest

from speckle3d.core.errors import Speckle3DError

ROOT = Path(__file__).resolve().parents[2]
VARIABLE = "SPECKLE3D_MUTANT"
MISFIT = 99
"""How a run of tests ends in which a mutant's change itself failed."""


@dataclass(frozen=True)
class Mutant:
    """A change of a function, and the tests that are to notice.

    Attributes
    ----------
    function : str
        Module and name.
    change : callable
        Called with the function, its arguments and those with names; returns what the mutant returns.
    tests : str
        A file of tests, or which rows of the accuracy set, as pytest's ``-k`` has it.
    """

    function: str
    change: Callable
    tests: str

    @property
    def selection(self):
        return [f"tests/{self.tests}"] if "/" in self.tests else ["tests/accuracy", "-k", self.tests]


def without_tissue(function, problem, *arguments):
    from speckle3d.motion.coherence import Coherence
    from speckle3d.motion.planes import fully_developed

    return Coherence(np.zeros(1), *fully_developed(len(problem.patches)), 1.0, 2e-3, np.full(2, 1e-4))


def bend_curves(function, sweep, curves, *arguments, **keywords):
    """Distances 8 % short at the skin, right at 20 mm, and long below: the curves of another lens."""
    distance, factor = curves.distance_mm, 1.0 + 0.004 * (curves.depth_mm - 20.0)
    rho = [np.interp(distance / f, distance, row) for f, row in zip(factor, curves.correlation, strict=True)]
    return function(sweep, replace(curves, correlation=np.array(rho)), *arguments, **keywords)


def without_curves(tracking):
    """Claims without what the curves' common error adds to the distance."""
    covariance = tracking.covariance.copy()
    z = tracking.image.apply(tracking.grid.centre_mm)[:, 2]
    covariance[:, 2, 2] -= (tracking.shared.curves_sigma * (z - z[0])) ** 2
    return replace(tracking, covariance=covariance)


def overcorrect(function, tracking, *arguments, **keywords):
    """Poses that are as far off the image's on the other side as the correction moved them."""
    corrections = function(tracking, *arguments, **keywords)
    for mode, m in corrections.items():
        right = m.poses[0].inv() * m.poses
        corrections[mode] = replace(m, poses=m.poses[0] * tracking.image * right.inv() * tracking.image)
    return corrections


def late(sweep):
    sensors = {"tracker": sweep.tracker, "orientation": sweep.orientation}
    shifts = {k: v and replace(v, time_offset_s=v.time_offset_s + 0.05) for k, v in sensors.items()}
    return replace(sweep, **shifts)


def in_metres(read):
    place_mm = read.translation_mm
    return read if place_mm is None else replace(read, translation_mm=1e-3 * place_mm)


def enlarge(solution):
    return replace(solution, chain=replace(solution.chain, pixel_mm=1.03 * solution.chain.pixel_mm))


def on_return(change):
    """A change of what a function returns."""
    return lambda function, *arguments, **keywords: change(function(*arguments, **keywords))


TRACK, DIRECTION = "speckle3d.tracking:track", "speckle3d.motion.sensors:settle_direction"
COHERENCE = "speckle3d.motion.coherence:estimate_coherence"
MUTANTS = {
    "tissue correction off": Mutant(COHERENCE, without_tissue, "tilt and tissue and not independent"),
    "straightening as it is": Mutant(TRACK, bend_curves, "tilt or length"),
    "claims halved": Mutant(TRACK, on_return(lambda t: replace(t, covariance=t.covariance / 4.0)), "claim"),
    "claim without the curves' part": Mutant(TRACK, on_return(without_curves), "claim"),
    "drift correction in the wrong sense": Mutant("speckle3d.corrections:correct", overcorrect, "tilt"),
    "mirror not resolved": Mutant(DIRECTION, lambda *_, **__: (1, "assumed"), "length and phantom"),
    "sign of the motion": Mutant(DIRECTION, on_return(lambda r: (-r[0], r[1])), "length and phantom"),
    "sensors' clock off by 50 ms": Mutant("speckle3d.io.load:load_sweep", on_return(late), "clock"),
    "quaternion order swapped": Mutant(
        "speckle3d.core.geometry:rotations_from_quaternions",
        lambda function, wxyz, where: function(np.roll(wxyz, 1, axis=-1), where),
        "orientation_sensor",
    ),
    "voxels shifted by one": Mutant(
        "speckle3d.imaging.voxels.volume:compound",
        on_return(lambda volume: replace(volume, voxels=np.roll(volume.voxels, 1, axis=2))),
        "imaging/test_digital_phantom.py",
    ),
    "wires mislabelled": Mutant(
        "calibration.detection.labelling:label_by_calibration",
        on_return(lambda dots: replace(dots, wire=np.where(dots.wire < 2, 1 - dots.wire, dots.wire))),
        "calibration/detection/test_labelling.py",
    ),
    "calibration's scale 3 % off": Mutant(
        "calibration.plane:calibrate_plane", on_return(enlarge), "calibration/test_plane.py"
    ),
    "frames never flagged": Mutant(
        "speckle3d.matching.quality:flag_frames", on_return(np.zeros_like), "matching/test_quality.py"
    ),
    "patches half a millimetre deeper": Mutant(
        "speckle3d.matching.patches:lay_patches",
        on_return(lambda grid: replace(grid, centre_mm=grid.centre_mm + np.array([0.0, 0.5]))),
        "matching/test_patches.py",
    ),
    "planes without a side": Mutant(
        "speckle3d.motion.signs:on_path", lambda function, planes, path: planes, "motion/test_signs.py"
    ),
    "a sensor's spikes kept": Mutant(
        "speckle3d.examine.sensors:spikes", on_return(np.zeros_like), "examine/test_sensors.py"
    ),
    "claims of fusion a third": Mutant(
        "speckle3d.correction.fused:fuse",
        on_return(lambda result: replace(result, covariance=result.covariance / 9.0)),
        "claim and fused and not independent",
    ),
    "mounting in metres": Mutant(
        "speckle3d.io.family.calibrations:read_calibration",
        on_return(in_metres),
        "io/family/test_calibrations.py",
    ),
    "wrong lines weigh as much": Mutant(
        "calibration.robust:absolute_weights", on_return(np.ones_like), "calibration/test_plane.py"
    ),
    "worlds taken the other way": Mutant(
        "xsens.logs.assembly:_north_deg", on_return(lambda degrees: -degrees), "xsens/logs/test_worlds.py"
    ),
}


def apply(mutant):
    """Put a mutant's function into its module, before others import it from there."""
    module, name = mutant.function.split(":")
    module = importlib.import_module(module)
    function = getattr(module, name)

    @wraps(function)
    def mutate(*arguments, **keywords):
        try:
            return mutant.change(function, *arguments, **keywords)
        except Speckle3DError:
            raise  # what the package itself refuses
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            pytest.exit(f"{type(error).__name__}: {error}", MISFIT)

    setattr(module, name, mutate)


if os.environ.get(VARIABLE):  # in a process of tests, as their plug-in
    apply(MUTANTS[os.environ[VARIABLE]])


def run_tests(name, selection, folder):
    """Code with which the tests end, and their output."""
    paths = os.pathsep.join([str(ROOT), str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": paths, VARIABLE: name, "SPECKLE3D_ACCURACY_SWEEPS": str(folder)}
    command = [
        sys.executable,
        *["-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "mutants", "-x", "-m", ""],
        *selection,
    ]
    process = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    return process.returncode, process.stdout + process.stderr


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"of {', '.join(MUTANTS)}; by default all".replace("%", "%%")
    )
    parser.add_argument("--keep", type=Path, help="folder of the accuracy set's sweeps, made if not there")
    options = parser.parse_args()
    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    alive = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = (options.keep or Path(scratch) / "sweeps").resolve()
        folder.mkdir(parents=True, exist_ok=True)
        for name in options.names or MUTANTS:
            code, output = run_tests("", MUTANTS[name].selection, folder)
            if code:
                sys.exit(f"{output}\nexpected tests that pass without a mutant")
            code, output = run_tests(name, MUTANTS[name].selection, folder)
            killers = re.findall(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", output, re.MULTILINE)
            if code == 1 and killers:
                print(f"{name}: killed by {'; '.join(killers)}", flush=True)
                continue
            alive.append(name)
            why = "survived" if code == 0 else f"does not apply, mend it\n{output[-1500:]}"
            print(f"mutant {name}: {why}", flush=True)
    sys.exit(1 if alive else 0)


if __name__ == "__main__":
    main()
