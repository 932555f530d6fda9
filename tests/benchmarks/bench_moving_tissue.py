"""Length over tissue that is not at rest: pressed, sliding along with the probe, pulsating.

Run: ``python tests/benchmarks/bench_moving_tissue.py [--seeds 3] [--length-mm 6] [--signal rf|bmode]``.
"""

import argparse
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from accuracy_set import SHEET, grey
from options import parsed
from scipy.spatial.transform import RigidTransform

from speckle3d.pipeline import track
from speckle3d.sheet_curves import data_sheet_curves
from speckle3d.simulation.presets import SimulationSettings, simulate

FIRST_SEED = 5001
STRAIN, SLIDING, PULSE_MM, PULSE_HZ, VESSEL_MM = 0.01, 0.05, 0.1, 1.2, 4.0
"""Strain at the end of the sweep; share of the probe's way that tissue goes along; pulse; depth over which it
falls to 1/e on either side of a vessel in the middle of the image."""


@dataclass(frozen=True)
class Deformed:
    """A medium whose scatterers have moved along the beam by some share or depth since the first frame."""

    medium: object
    poses: RigidTransform
    shift_mm: object
    """Of depths, at a frame: (depth_mm, frame) to mm."""

    def scatterers(self, medium_from_image, box):
        apart = self.poses.translation - medium_from_image.translation
        frame = int(np.argmin((apart**2).sum(axis=1)))
        for position, strength in self.medium.scatterers(medium_from_image, box):
            moved = position.copy()
            moved[:, 1] += self.shift_mm(position[:, 1], frame)
            yield moved, strength


def cases(sweep):
    """Frames of the same sweep over tissue at rest and in motion."""
    frames, poses = sweep.frames, sweep.frames.medium_from_image
    way = poses.translation[:, 2] - poses.translation[0, 2]
    pulse = PULSE_MM * np.sin(2 * np.pi * PULSE_HZ * (sweep.frame_time_s - sweep.frame_time_s[0]))
    middle = sweep.grid.depth_mm / 2

    def along_beam(shift_mm):
        return replace(frames, medium=Deformed(frames.medium, poses, shift_mm))

    def along_sweep(moved_mm):
        back = RigidTransform.from_translation(np.outer(moved_mm, [0.0, 0.0, -1.0]))
        return replace(frames, medium_from_image=back * poses)

    return {
        "at rest": frames,
        "pressed by 1 %": along_beam(lambda y, k: -STRAIN * y * k / len(sweep)),
        "sliding along by 5 %": along_sweep(SLIDING * way),
        "pulsating 0.1 mm along the sweep": along_sweep(pulse),
        "pulsating 0.1 mm along the beam": along_beam(
            lambda y, k: pulse[k] * np.exp(-np.abs(y - middle) / VESSEL_MM)
        ),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--length-mm", type=float, default=6.0)
    parser.add_argument("--vectors", type=int, default=36)
    parser.add_argument("--signal", choices=("rf", "bmode"), default="rf")
    options = parsed(parser, seeds=1, length_mm=1.5, vectors=20)
    size = {"length_mm": options.length_mm, "vectors": options.vectors, "samples": 2600}
    rows = {}
    for seed in range(FIRST_SEED, FIRST_SEED + options.seeds):
        sweep = simulate(SimulationSettings(preset="tissue", seed=seed, **size))[0].sweep
        true = np.ptp((sweep.truth[0].inv() * sweep.truth).apply(sweep.grid.centre_mm)[:, 2])
        for name, frames in cases(sweep).items():
            case = replace(sweep, frames=frames, truth=None, tracker=None, orientation=None)
            case = grey(case) if options.signal == "bmode" else case
            case = replace(case, frames=np.stack([case.frames[k] for k in range(len(case))]))
            tracked = track(case, data_sheet_curves(SHEET, case))
            length = np.ptp(tracked.image.apply(sweep.grid.centre_mm)[:, 2])
            sigma = np.sqrt(tracked.covariance[:, 2, 2].max())
            rows.setdefault(name, []).append((length / true - 1, sigma / length, (length - true) / sigma))
    print(f"{'':34s} length, %                claim, %   error over claim")
    for name, values in rows.items():
        error, claim, score = np.array(values).T
        shown = " ".join(f"{100 * e:+6.1f}" for e in error)
        print(f"{name:34s} {shown}     {100 * claim.mean():6.1f}     {np.abs(score).max():.1f}")


if __name__ == "__main__":
    main()
