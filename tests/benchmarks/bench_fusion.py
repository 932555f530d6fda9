"""Orientation on the BROAD trials: errors beside VQF's in the same run, and speed against real time.

python tests/benchmarks/bench_fusion.py FOLDER   (with the trials' .mat files)
"""

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from broad import TRIALS, errors_deg, read_trial
from vqf import VQF

from xsens.fusion import orient


def main():
    folder = Path(sys.argv[1])
    for name in TRIALS:
        log, true, moving = read_trial(folder, name)
        peer = VQF(1.0 / log.rate_hz)
        theirs = peer.updateBatch(log.gyroscope_rad_s, log.accelerometer_m_s2, log.magnetometer_au)["quat9D"]
        print(f"{name}: total, heading, inclination, degrees")
        print(f"  VQF       {errors_deg(theirs, true, moving).round(2)}")
        for smooth in (False, True):
            start = time.process_time()
            found = orient(log, smooth=smooth).rotations.world_from_sensor.as_quat(scalar_first=True)
            pace = log.duration_s / (time.process_time() - start)
            label = "smoother" if smooth else "filter"
            print(f"  {label:9} {errors_deg(found, true, moving).round(2)}, {pace:.0f} times real time")


if __name__ == "__main__":
    main()
