"""Orientation on the BROAD trials: errors beside VQF's in the same run, and speed against real time.

python tests/benchmarks/bench_fusion.py FOLDER   (with the trials' .mat files)

With --sensitivity: each of the filter's parameters halved and doubled, and what that does to the errors.
"""

import sys
import time
from dataclasses import fields, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from broad import TRIALS, east_first, errors_deg, read_trial
from vqf import VQF

from xsens.fusion.orient import orient
from xsens.fusion.settings import FusionSettings


def main():
    folder = Path(sys.argv[1])
    for name in TRIALS:
        log, true, moving = read_trial(folder, name)
        peer = VQF(1.0 / log.rate_hz)
        theirs = peer.updateBatch(log.gyroscope_rad_s, log.accelerometer_m_s2, log.magnetometer_au)["quat9D"]
        print(f"{name}: total, heading, inclination, degrees; the same without a constant heading")
        print(f"  VQF       {both_ways(theirs, true, moving)}")
        for method in ("filter", "smoother"):
            start = time.process_time()
            found = east_first(orient(log, method=method).rotations.world_from_sensor)
            pace = log.duration_s / (time.process_time() - start)
            print(f"  {method:9} {both_ways(found, true, moving)}, {pace:.0f} times real time")


def both_ways(found, true, moving):
    return " ".join(str(errors_deg(found, true, moving, steady).round(2)) for steady in (False, True))


def sensitivity():
    """Total error of filter | smoother on each trial, degrees, without a constant heading."""
    trials = [read_trial(Path(sys.argv[1]), name) for name in TRIALS]
    print(f"{'':32} " + " ".join(f"{name[:13]:^13}" for name in TRIALS))
    row("as it is", FusionSettings(), trials)
    for entry in fields(FusionSettings):
        value = getattr(FusionSettings(), entry.name)
        if not isinstance(value, bool) and entry.name != "gravity_m_s2":
            for factor in (0.5, 2.0):
                changed = replace(FusionSettings(), **{entry.name: factor * value})
                row(f"{entry.name} x {factor:g}", changed, trials)


def row(label, settings, trials):
    cells = []
    for log, true, moving in trials:
        both = []
        for method in ("filter", "smoother"):
            found = east_first(orient(log, settings, method).rotations.world_from_sensor)
            both.append(errors_deg(found, true, moving, steady=True)[0])
        cells.append(f"{both[0]:5.2f} | {both[1]:5.2f}")
    print(f"{label:32} " + " ".join(cells), flush=True)


if __name__ == "__main__":
    sensitivity() if "--sensitivity" in sys.argv else main()
